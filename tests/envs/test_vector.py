"""The environment of many robots beside single ones: autoresets, pools, threads, copies."""

from __future__ import annotations

import copy
import functools
import multiprocessing
import pickle
import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from numpy.testing import assert_array_equal

import cyclic_env
from cyclic_env import CyclicLoopEnv, CyclicLoopVectorEnv, UsageError
from cyclic_env.engine.building import INFO
from tests.helpers import assert_same, bumping_actions, roll_out


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


@pytest.mark.parametrize("context", ["spawn", "fork"])
def test_async_vector_env_works(context: str) -> None:
    make = functools.partial(gymnasium.make, "cyclic_env:CyclicLoop-v0", map_name="ring")
    env = gymnasium.vector.AsyncVectorEnv([make] * 2, context=context)
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


def test_the_number_of_threads_changes_no_bit() -> None:
    actions = bumping_actions(100, 70)
    envs = [CyclicLoopVectorEnv(70, "office", noise="typical", num_threads=threads) for threads in (1, 3)]
    for env in envs:
        env.reset(seed=0)
    for action in actions:
        assert_same(envs[0].step(action), envs[1].step(action))


def test_info_records_are_the_infos_of_the_moment_and_cannot_be_written_to() -> None:
    env = CyclicLoopVectorEnv(3, "ring")
    *_, infos = env.reset(seed=0)
    records = env.info_records
    for action in [*bumping_actions(5, 3), None]:
        for name in INFO.names or ():
            assert_array_equal(records[name], infos[name], strict=True)
        if action is not None:
            *_, infos = env.step(action)
    for name, values in (("x", records), (slice(None), infos["_coverage"])):
        with pytest.raises(ValueError, match="read-only"):
            values[name] = 0


def test_a_timer_adds_up_the_stages_of_the_steps() -> None:
    env = CyclicLoopVectorEnv(3, "ring", num_threads=1)
    env.reset(seed=0)
    timer = env.time_stages()
    env.step(np.zeros((3, 4)))
    assert set(timer.seconds) == {"actions", "drive", "judge", "sensors", "observation"}
    assert all(seconds > 0 for seconds in timer.seconds.values())


def test_rows_left_out_of_a_step_draw_nothing_and_ended_ones_may_wait_for_their_reset() -> None:
    settings: dict[str, Any] = {"map_name": "ring", "noise": "typical", "step_budget": 4, "autoreset_mode": "DISABLED"}
    some, alone = CyclicLoopVectorEnv(2, **settings), CyclicLoopVectorEnv(1, **settings)
    actions = np.full((2, 4), 0.5, np.float32)
    some.reset(seed=5)
    expected, _ = alone.reset(seed=5)
    for step in range(4):
        expected, *_ = alone.step(actions[:1])
        if step < 2:
            some.step(actions, active=np.array([False, True]))
    steps = [some.step(actions, active=np.array([True, False])) for _ in range(4)]
    observation, rewards, *_ = steps[-1]
    assert all((observation[name][0] == expected[name][0]).all() for name in expected)
    assert rewards[0] != 0 == rewards[1]
    _, _, _, truncated, _ = some.step(actions, active=np.array([False, True]))
    assert truncated.tolist() == [True, False]
    with pytest.raises(UsageError, match="ended"):
        some.step(actions)
    with pytest.raises(UsageError, match="DISABLED"):
        CyclicLoopVectorEnv(1, "ring").step(actions[:1], active=np.array([True]))
