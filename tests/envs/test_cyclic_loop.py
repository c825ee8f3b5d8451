"""The contract of the environment: spaces, info, randomness, copies, and the vector env beside single ones."""

from __future__ import annotations

import copy
import json
import multiprocessing
import pickle
import subprocess
import sys
import warnings
from typing import Any
from unittest.mock import Mock

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from numpy.testing import assert_array_equal

import cyclic_env
from cyclic_env import CyclicLoopEnv, CyclicLoopVectorEnv
from cyclic_env.config import ACTION_TYPES, NOISE_PRESETS, ActionType
from cyclic_env.engine.building import INFO
from cyclic_env.task.rewards import REWARD_TERMS
from tests.helpers import bumping_actions

Rollout = list[tuple[Any, ...]]


def roll_out(env: Any, actions: np.ndarray, seed: int | None) -> Rollout:
    """Reset and step a single env, beginning anew when an episode ends; return all that it returned."""
    rollout: Rollout = [env.reset(seed=seed)]
    for action in actions:
        rollout.append(env.step(action))
        if rollout[-1][2] or rollout[-1][3]:
            rollout.append(env.reset())
    return rollout


def assert_same(a: Any, b: Any) -> None:
    """Assert that two structures of dicts, tuples, arrays and scalars are equal to the bit, types included."""
    assert type(a) is type(b)
    if isinstance(a, dict):
        assert a.keys() == b.keys()
        for key in a:
            assert_same(a[key], b[key])
    elif isinstance(a, list | tuple):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            assert_same(x, y)
    elif isinstance(a, np.ndarray) and a.dtype == object:
        assert_same(a.tolist(), b.tolist())
    else:
        assert_array_equal(a, b, strict=True)


def test_importing_the_package_is_quick_and_loads_no_heavy_library() -> None:
    heavy = ("numba", "shapely", "pymunk", "pygame", "torch")
    code = f"import sys, cyclic_env; print([name for name in {heavy} if name in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


@pytest.mark.parametrize("action_type", ACTION_TYPES)
def test_gymnasiums_checker_has_no_warning_on_any_plan(
    plan: cyclic_env.FloorPlan, action_type: ActionType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")  # it opens a window as well
    env = gymnasium.make("CyclicLoop-v0", map_name=plan.name, action_type=action_type, render_mode="rgb_array")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)


@pytest.mark.parametrize("action_type", ACTION_TYPES)
def test_stable_baselines_checker_has_no_warning_on_any_plan(
    plan: cyclic_env.FloorPlan, action_type: ActionType
) -> None:
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        checker.check_env(CyclicLoopEnv(plan.name, action_type=action_type))


def test_info_has_the_same_keys_and_types_at_reset_and_at_every_step() -> None:
    rollout = roll_out(CyclicLoopEnv("ring"), bumping_actions(300, 1)[:, 0], seed=0)
    for *_, info in rollout:
        assert list(info) == [*(INFO.names or ()), "reward_terms"]
        assert [type(value) for value in info.values()] == [type(value) for value in rollout[0][-1].values()]
        assert list(info["reward_terms"]) == list(REWARD_TERMS)
        assert all(type(value) is float for value in info["reward_terms"].values())


def test_reward_is_the_sum_of_its_terms() -> None:
    for step in roll_out(CyclicLoopEnv("ring"), bumping_actions(300, 1)[:, 0], seed=0)[1:]:
        assert step[1] == pytest.approx(sum(step[-1]["reward_terms"].values()), abs=1e-12)


def test_no_term_of_the_reward_is_minus_zero() -> None:
    for step in roll_out(CyclicLoopEnv("ring"), bumping_actions(300, 1)[:, 0], seed=0)[1:]:
        terms = np.array(list(step[-1]["reward_terms"].values()))
        assert not np.signbit(terms[terms == 0]).any()


def test_observations_stay_in_their_space_and_vary(plan: cyclic_env.FloorPlan) -> None:
    env = CyclicLoopEnv(plan, noise="poor")
    rollout = roll_out(env, bumping_actions(200, 1)[:, 0], seed=0)
    assert all(env.observation_space.contains(step[0]) for step in rollout)
    for name in ("laser", "distance", "compass"):
        assert np.ptp([step[0][name] for step in rollout], axis=0).max() > 0


def test_returned_observations_are_not_written_to_later() -> None:
    env = CyclicLoopEnv("ring")
    first, _ = env.reset(seed=0)
    kept = copy.deepcopy(first)
    for action in bumping_actions(20, 1)[:, 0]:
        env.step(action)
    assert_same(first, kept)


@pytest.mark.parametrize("noise", NOISE_PRESETS)
def test_same_seed_gives_the_same_bits_after_another_episode_and_with_wall_contact(noise: str) -> None:
    actions = bumping_actions(2000, 1)[:, 0]
    once = roll_out(CyclicLoopEnv("office", noise=noise), actions, seed=5)
    env = CyclicLoopEnv("office", noise=noise)
    roll_out(env, bumping_actions(500, 1, seed=9)[:, 0], seed=3)
    again = roll_out(env, actions, seed=5)
    assert once[-1][-1]["collisions"] > 10
    assert_same(once, again)


def rollout_in_another_process(queue: Any) -> None:
    queue.put(roll_out(CyclicLoopEnv("killian_court", noise="typical"), bumping_actions(2000, 1)[:, 0], seed=11))


def test_same_seed_gives_the_same_bits_in_another_process() -> None:
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    process = context.Process(target=rollout_in_another_process, args=(queue,))
    process.start()
    theirs = queue.get(timeout=120)
    process.join()
    ours = roll_out(CyclicLoopEnv("killian_court", noise="typical"), bumping_actions(2000, 1)[:, 0], seed=11)
    assert ours[-1][-1]["collisions"] > 10
    assert_same(ours, theirs)


def test_different_seeds_differ_only_where_something_is_random() -> None:
    actions = bumping_actions(50, 1)[:, 0]
    assert_same(roll_out(CyclicLoopEnv("ring"), actions, 0), roll_out(CyclicLoopEnv("ring"), actions, 1))
    noisy = [roll_out(CyclicLoopEnv("ring", noise="typical"), actions, seed) for seed in (0, 1)]
    assert (noisy[0][0][0]["laser"] != noisy[1][0][0]["laser"]).any()


def test_a_batch_row_equals_a_single_env_to_the_bit_over_2000_steps_with_wall_contact() -> None:
    num_robots = 70  # more than two Spaces, so that several threads share the work
    actions = bumping_actions(2000, num_robots)
    settings: dict[str, Any] = {"map_name": "killian_court", "noise": "calibrated"}
    env = CyclicLoopVectorEnv(num_robots, **settings)
    batch = [env.reset(seed=40), *(env.step(action) for action in actions)]
    for row in (0, 33, 69):
        single = roll_out(CyclicLoopEnv(**settings), actions[:, row], seed=40 + row)
        assert single[-1][-1]["collisions"] > 10
        for theirs, ours in zip(batch, single, strict=True):
            for name, value in ours[0].items():
                assert_array_equal(theirs[0][name][row], value, strict=True)
            for name in INFO.names or ():
                assert theirs[-1][name][row] == ours[-1][name]
            for name, value in ours[-1]["reward_terms"].items():
                assert theirs[-1]["reward_terms"][name][row] == value
        assert [float(step[1][row]) for step in batch[1:]] == [step[1] for step in single[1:]]


AUTORESETS = [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP, AutoresetMode.DISABLED]


@pytest.mark.parametrize("noise", ["ideal", "typical"])
@pytest.mark.parametrize("mode", AUTORESETS)
def test_the_vector_env_returns_what_a_sync_vector_env_does(mode: AutoresetMode, noise: str) -> None:
    settings: dict[str, Any] = {"map_name": ["ring", "office", "dead_ends"], "noise": noise, "random_start": True}
    settings["step_budget"] = 37
    settings["terminate_on_collision"] = True
    num_robots = 5
    ours = CyclicLoopVectorEnv(num_robots, autoreset_mode=mode, **settings)
    theirs = SyncVectorEnv([lambda: CyclicLoopEnv(**settings)] * num_robots, autoreset_mode=mode)
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert_same(ours.reset(seed=3), theirs.reset(seed=3))
    ends = 0
    for action in bumping_actions(150, num_robots):
        step = ours.step(action)
        assert_same(step, theirs.step(action))
        ended = step[2] | step[3]
        ends += ended.sum()
        if mode == AutoresetMode.DISABLED and ended.any():
            mask = {"reset_mask": ended}
            assert_same(ours.reset(options=dict(mask)), theirs.reset(options=dict(mask)))
    assert ends > 10
    assert_same(ours.reset(seed=[4, None, 7, None, 1]), theirs.reset(seed=[4, None, 7, None, 1]))


def test_make_vec_gives_the_native_vector_env_with_any_autoreset_mode() -> None:
    for mode in ("NextStep", "SAME_STEP", AutoresetMode.DISABLED):
        env = gymnasium.make_vec("CyclicLoop-v0", num_envs=3, map_name="ring", autoreset_mode=mode)
        assert isinstance(env.unwrapped, CyclicLoopVectorEnv)
        assert isinstance(env.metadata["autoreset_mode"], AutoresetMode)
        env.close()


def test_gymnasiums_vector_wrappers_take_it() -> None:
    env: Any = gymnasium.make_vec("CyclicLoop-v0", num_envs=3, map_name="ring", step_budget=20)
    env = gymnasium.wrappers.vector.DictInfoToList(gymnasium.wrappers.vector.RecordEpisodeStatistics(env))
    env.reset(seed=0)
    infos = [env.step(action)[-1] for action in bumping_actions(20, 3)]
    assert infos[-1][2]["episode"]["l"] == 20
    assert infos[-1][0]["coverage"] > 0


def test_masks_of_the_infos_cannot_be_written_to() -> None:
    *_, infos = CyclicLoopVectorEnv(2, "ring").reset(seed=0)
    with pytest.raises(ValueError, match="read-only"):
        infos["_coverage"][:] = False


@pytest.mark.parametrize("map_name", ["ring", "twin_rings"])
def test_max_episode_steps_truncates_and_changes_nothing_else_on_both_faces(map_name: str) -> None:
    actions = bumping_actions(40, 1)
    single = gymnasium.make("CyclicLoop-v0", map_name=map_name, max_episode_steps=40)
    vector = gymnasium.make_vec("CyclicLoop-v0", num_envs=1, map_name=map_name, max_episode_steps=40)
    free = CyclicLoopEnv(map_name)
    for env in (single, vector, free):
        env.reset(seed=0)
    steps = [(single.step(action[0]), vector.step(action), free.step(action[0])) for action in actions]
    for one, many, unlimited in steps:
        assert one[1] == many[1][0] == unlimited[1]
        assert one[3] == many[3][0]
    assert steps[-1][0][3]
    assert not steps[-1][2][3]


def test_the_spec_survives_json() -> None:
    env = gymnasium.make(
        "CyclicLoop-v0", map_name="ring", noise={"laser_sigma": 0.1}, robot={"radius": 0.3}, laser={"num_beams": 90}
    )
    assert env.spec is not None
    text = env.spec.to_json()
    json.loads(text)
    again = gymnasium.make(EnvSpec.from_json(text))
    assert_same(env.reset(seed=1), again.reset(seed=1))


@pytest.mark.parametrize("copied", [lambda env: pickle.loads(pickle.dumps(env)), copy.deepcopy])
def test_a_copied_env_goes_on_to_the_bit_where_no_wall_is_touched(copied: Any) -> None:
    env = CyclicLoopEnv("ring", noise="typical")
    env.reset(seed=0)
    turning = np.array([0.3, -0.2, -1, 0], np.float32)
    for _ in range(30):
        env.step(turning)
    twin = copied(env)
    for _ in range(50):
        assert_same(env.step(turning), twin.step(turning))
    assert env.trajectory()[-1, 2] > 0
    assert_same(env.reset(), twin.reset())


def test_a_pickle_holds_no_room_for_steps_to_come() -> None:
    for map_name in ("ring", "dead_ends"):
        sizes = []
        for step_budget in (100, 1_000_000):
            env = CyclicLoopEnv(map_name, step_budget=step_budget)
            env.reset(seed=0)
            actions = bumping_actions(80, 1)[:, 0]
            actions[:, :2] = (0.3, -0.2)
            for action in actions[:70]:
                env.step(action)
            text = pickle.dumps(env)
            sizes.append(len(text))
            twin = pickle.loads(text)
            for action in actions[70:]:
                assert_same(env.step(action), twin.step(action))
            assert_same(env.trajectory(), twin.trajectory())
            assert_same(env.engine.claims(0), twin.engine.claims(0))
            assert env.engine.episodes.memory.track.shape == twin.engine.episodes.memory.track.shape
        assert abs(sizes[1] - sizes[0]) < 1000


def test_a_copied_env_goes_on_within_a_millimetre_at_a_wall() -> None:
    env = CyclicLoopEnv("ring")
    env.reset(seed=0, options={"start": (*env.floor_plan.start[:2], 0.7)})
    ahead = np.array([1, 1, -1, 0], np.float32)
    infos = [env.step(ahead)[-1] for _ in range(25)]
    assert infos[-1]["collisions"] > 0
    twin = copy.deepcopy(env)
    for _ in range(25):
        ours, theirs = env.step(ahead)[-1], twin.step(ahead)[-1]
        assert np.hypot(ours["x"] - theirs["x"], ours["y"] - theirs["y"]) < 1e-3


def test_a_copied_vector_env_goes_on_and_shares_nothing() -> None:
    env = CyclicLoopVectorEnv(40, "ring", noise="calibrated", random_start=True)
    env.reset(seed=0)
    actions = np.tile(np.array([0.2, -0.2, -1, 0], np.float32), (40, 1))
    env.step(actions)
    twin = copy.deepcopy(env)
    other = copy.deepcopy(env)
    other.reset(seed=9)
    other.step(actions)
    for _ in range(5):
        assert_same(env.step(actions), twin.step(actions))


@pytest.mark.parametrize("context", ["spawn", "forkserver", "fork"])
def test_async_vector_env_works(context: str) -> None:
    env = gymnasium.vector.AsyncVectorEnv(
        [lambda: gymnasium.make("cyclic_env:CyclicLoop-v0", map_name="ring")] * 2, context=context
    )
    env.reset(seed=0)
    observations, *_ = env.step(bumping_actions(1, 2)[0])
    env.close()
    assert observations["laser"].shape == (2, 180)


def test_a_forked_process_steps_an_env_that_has_threads() -> None:
    env = CyclicLoopVectorEnv(130, "ring")
    env.reset(seed=0)
    actions = np.zeros((130, 4), np.float32)
    env.step(actions)
    process = multiprocessing.get_context("fork").Process(target=env.step, args=(actions,))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # Python 3.12 says what this test is about
        process.start()
    process.join(timeout=60)
    assert process.exitcode == 0


def test_a_pool_draws_every_plan_and_a_row_by_itself() -> None:
    env = CyclicLoopVectorEnv(64, ["ring", "grid", "office"])
    env.reset(seed=0)
    assert {env.floor_plan(row).name for row in range(64)} == {"ring", "grid", "office"}
    single = CyclicLoopEnv(["ring", "grid", "office"])
    single.reset(seed=17)
    assert single.floor_plan is env.floor_plan(17)


def test_start_option_and_random_start_are_obeyed() -> None:
    env = CyclicLoopEnv("ring")
    x, y, _ = env.floor_plan.start
    *_, info = env.reset(options={"start": (x + 0.1, y, 4.0)})
    assert (info["x"], info["y"]) == (x + 0.1, y)
    assert info["heading"] == pytest.approx(4.0 - 2 * np.pi)
    vector = CyclicLoopVectorEnv(3, "ring", random_start=True)
    starts = np.array([[x, y, 0.0], [x + 0.2, y, 1.0], [x, y, 2.0]])
    *_, info = vector.reset(seed=0, options={"start": starts})
    assert_array_equal(info["x"], starts[:, 0])
    *_, info = vector.reset(seed=0)
    assert len(set(info["x"])) == 3


def test_a_wheel_that_spins_at_a_wall_adds_no_distance(square_room: cyclic_env.FloorPlan) -> None:
    env = CyclicLoopEnv(square_room)
    env.reset(options={"start": (9.5, 5.0, 0.0)})
    readings = [env.step(np.array([1, 1, -1, 0], np.float32))[0]["distance"][0] for _ in range(40)]
    assert readings[-1] == pytest.approx(0.25, abs=0.07)
    assert readings[-1] == pytest.approx(readings[10], abs=0.06)


def test_dead_reckoning_recovers_the_path_without_noise(square_room: cyclic_env.FloorPlan) -> None:
    env = CyclicLoopEnv(square_room)
    observation, info = env.reset(seed=0)
    position, distance = np.array([info["x"], info["y"]]), observation["distance"][0]
    for left, right in [(1, 1)] * 10 + [(0.3, -0.3)] * 9 + [(0.8, 0.8)] * 9 + [(-1, -1)] * 5:
        observation, *_, info = env.step(np.array([left, right, -1, 0], np.float32))
        position += (observation["distance"][0] - distance) * observation["compass"]
        distance = observation["distance"][0]
    assert info["path_length_m"] > 4
    assert position == pytest.approx([info["x"], info["y"]], abs=0.02)


def test_out_of_range_actions_are_clipped(square_room: cyclic_env.FloorPlan) -> None:
    for action_type in ("wheels", "twist"):
        paths = []
        for scale in (1, 50):
            env = CyclicLoopEnv(square_room, action_type=action_type)
            env.reset(seed=0)
            paths.append([env.step(scale * np.array([1, 1, -1, 0], np.float32))[-1]["x"] for _ in range(20)])
        assert paths[0] == paths[1]


def test_a_twist_shrinks_as_a_whole_at_the_wheels_limit(square_room: cyclic_env.FloorPlan) -> None:
    env = CyclicLoopEnv(square_room, action_type="twist", robot={"wheel_time_constant": 0.0})
    env.reset(seed=0)
    steps = [env.step(np.array([1, 1, -1, 0], np.float32)) for _ in range(10)]
    # v = 1.2, omega = 3 asks 1.8 m/s of the right wheel: both shrink by 1.5, to 0.8 m/s and 2 rad/s.
    turned = np.unwrap([step[-1]["heading"] for step in steps])
    assert turned[-1] - turned[-2] == pytest.approx(2 * 0.2, abs=1e-6)
    assert steps[-1][0]["distance"][0] - steps[-2][0]["distance"][0] == pytest.approx(0.8 * 0.2, abs=1e-6)


def test_discrete_turns_are_on_the_spot(square_room: cyclic_env.FloorPlan) -> None:
    env = CyclicLoopEnv(square_room, action_type="discrete")
    env.reset(seed=0)
    headings = [env.step(np.array([2, 0]))[-1]["heading"] for _ in range(20)]
    assert headings[-1] - headings[-2] == pytest.approx(0.15 * 1.2 * 2 / 0.4 * 0.2)
    assert env.trajectory()[-1, 2] == pytest.approx(0, abs=1e-9)


def test_the_step_budget_of_killian_court_is_about_17700() -> None:
    assert CyclicLoopEnv("killian_court").step_budget == pytest.approx(17_700, abs=100)


def test_the_episode_truncates_at_the_step_budget() -> None:
    env = CyclicLoopEnv("ring", step_budget=10)
    rollout = roll_out(env, np.zeros((10, 4), np.float32), seed=0)
    assert [step[3] for step in rollout[1:11]] == [False] * 9 + [True]


def test_a_pool_prepares_a_plan_when_a_row_first_draws_it(monkeypatch: pytest.MonkeyPatch) -> None:
    prepared: list[str] = []
    reachable = cyclic_env.FloorPlan.reachable

    def counted(plan: cyclic_env.FloorPlan, *arguments: Any) -> Any:
        prepared.append(plan.name)
        return reachable(plan, *arguments)

    monkeypatch.setattr(cyclic_env.FloorPlan, "reachable", counted)
    env = CyclicLoopVectorEnv(4, "generated:train")
    assert prepared == ["generated:train,index=0"]
    for seed in (0, 1, 0):
        env.reset(seed=seed)
        assert {env.floor_plan(row).name for row in range(4)} <= set(prepared)
    assert len(prepared) == len(set(prepared)) <= 9


def test_plans_that_join_a_pool_late_change_no_bit_of_what_is_going_on() -> None:
    # They grow, so that all arrays do, while row 0 goes on in the first.
    pool = ["ring", "dead_ends", "grid", "killian_court"]
    seed_of = [next(seed for seed in range(99) if np.random.default_rng(seed).integers(4) == plan) for plan in range(4)]
    late, early = CyclicLoopVectorEnv(2, pool, noise="typical"), CyclicLoopVectorEnv(2, pool, noise="typical")
    for seed in seed_of:
        early.reset(seed=seed)
    assert (early.engine.is_prepared, late.engine.is_prepared) == (True, False)
    for plan, seed in enumerate(seed_of):
        options = {"reset_mask": np.array([plan == 0, True])}
        seeds = [seed_of[0], seed]
        assert_same(late.reset(seed=seeds, options=options), early.reset(seed=seeds, options=options))
        assert late.floor_plan(1).name == pool[plan]
        for action in bumping_actions(60, 2):
            assert_same(late.step(action), early.step(action))
    assert late.engine.is_prepared
    assert_array_equal(late.trajectory(0), early.trajectory(0))
    assert_array_equal(late.seen_cells(0), early.seen_cells(0))
    assert_same(pickle.loads(pickle.dumps(late)).reset(seed=3), early.reset(seed=3))


def test_a_plan_that_does_not_suit_is_refused_by_the_reset_that_draws_it(monkeypatch: pytest.MonkeyPatch) -> None:
    reachable = cyclic_env.FloorPlan.reachable

    def narrow(plan: cyclic_env.FloorPlan, *arguments: Any) -> Any:
        if plan.name.startswith("generated"):
            raise cyclic_env.FloorPlanError(f"floor plan {plan.name!r}: a corridor is too narrow.")
        return reachable(plan, *arguments)

    monkeypatch.setattr(cyclic_env.FloorPlan, "reachable", narrow)
    pool = ["ring", "generated:train,index=3"]
    with pytest.raises(cyclic_env.FloorPlanError, match="index=3"):
        CyclicLoopEnv(pool)  # it is named, so it is checked at once
    seed = next(seed for seed in range(5000) if np.random.default_rng(seed).integers(257) == 0)
    for env in (CyclicLoopEnv(["ring", "generated:train"]), CyclicLoopVectorEnv(1, ["ring", "generated:train"])):
        env.reset(seed=seed)
        actions = np.zeros(env.action_space.shape or ())
        env.step(actions)
        with pytest.raises(cyclic_env.FloorPlanError, match=r"'generated:train,index=\d+': a corridor is too narrow"):
            env.reset(seed=0)
        env.step(actions)  # the running episode goes on
        env.reset(seed=seed)
        env.step(actions)


def test_an_autoreset_that_draws_a_plan_that_does_not_suit_leaves_the_env_usable(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    env = CyclicLoopVectorEnv(2, ["ring", "generated:train"], step_budget=2, autoreset_mode="SAME_STEP")
    seed = next(seed for seed in range(5000) if np.random.default_rng(seed).integers(257) == 0)
    env.reset(seed=[seed, seed])
    actions = np.zeros((2, 4))
    env.step(actions)
    with monkeypatch.context() as patch:
        patch.setattr(cyclic_env.FloorPlan, "reachable", Mock(side_effect=cyclic_env.FloorPlanError("too narrow")))
        with pytest.raises(cyclic_env.FloorPlanError, match="too narrow"):
            env.step(actions)
    env.step(actions)
    env.reset(seed=[seed, seed])
    env.step(actions)
