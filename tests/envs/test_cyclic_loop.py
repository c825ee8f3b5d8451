"""The environment of one robot: spaces, info, randomness, copies, drives."""

from __future__ import annotations

import copy
import json
import multiprocessing
import pickle
import subprocess
import sys
import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common import env_checker

import cyclic_env
from cyclic_env import CyclicLoopEnv, map_names
from cyclic_env.config import ActionType
from cyclic_env.engine.building import INFO
from cyclic_env.task.rewards import REWARD_TERMS
from tests.helpers import assert_same, bumping_actions, roll_out


def test_importing_the_package_is_quick_and_loads_no_heavy_library() -> None:
    heavy = ("numba", "shapely", "pymunk", "pygame", "torch")
    code = f"import sys, cyclic_env; print([name for name in {heavy} if name in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


@pytest.mark.parametrize(
    ("name", "action_type"), [*((name, "wheels") for name in map_names()), ("ring", "twist"), ("ring", "discrete")]
)
def test_the_checkers_of_gymnasium_and_stable_baselines_have_no_warning(
    name: str, action_type: ActionType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")  # Gymnasium's opens a window as well
    env = gymnasium.make("CyclicLoop-v0", map_name=name, action_type=action_type, render_mode="rgb_array")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)
        env_checker.check_env(CyclicLoopEnv(name, action_type=action_type))


def test_info_has_the_same_keys_and_types_at_reset_and_at_every_step_and_the_reward_is_the_sum_of_its_terms() -> None:
    rollout = roll_out(CyclicLoopEnv("ring"), bumping_actions(300, 1)[:, 0], seed=0)
    for *_, info in rollout:
        assert list(info) == [*(INFO.names or ()), "reward_terms"]
        assert [type(value) for value in info.values()] == [type(value) for value in rollout[0][-1].values()]
        assert list(info["reward_terms"]) == list(REWARD_TERMS)
        assert all(type(value) is float for value in info["reward_terms"].values())
    for _, reward, *_, info in rollout[1:]:
        terms = np.array(list(info["reward_terms"].values()))
        assert reward == pytest.approx(terms.sum(), abs=1e-12)
        assert not np.signbit(terms[terms == 0]).any()


def test_observations_stay_in_their_space_vary_and_are_not_written_to_later(plan: cyclic_env.FloorPlan) -> None:
    env = CyclicLoopEnv(plan, noise="poor")
    first, _ = env.reset(seed=0)
    kept = copy.deepcopy(first)
    observations = [first, *(env.step(action)[0] for action in bumping_actions(200, 1)[:, 0])]
    assert all(env.observation_space.contains(observation) for observation in observations)
    for name in ("laser", "distance", "compass"):
        assert np.ptp([observation[name] for observation in observations], axis=0).max() > 0
    assert_same(first, kept)


@pytest.mark.parametrize("noise", ["ideal", "typical", "poor"])
def test_same_seed_gives_the_same_bits_after_another_episode_and_with_wall_contact(noise: str) -> None:
    actions = bumping_actions(1000, 1)[:, 0]
    once = roll_out(CyclicLoopEnv("office", noise=noise), actions, seed=5)
    env = CyclicLoopEnv("office", noise=noise)
    roll_out(env, bumping_actions(500, 1, seed=9)[:, 0], seed=3)
    again = roll_out(env, actions, seed=5)
    assert once[-1][-1]["collisions"] > 10
    assert_same(once, again)


def rollout_in_another_process(queue: Any) -> None:
    queue.put(roll_out(CyclicLoopEnv("killian_court", noise="typical"), bumping_actions(1000, 1)[:, 0], seed=11))


def test_same_seed_gives_the_same_bits_in_another_process() -> None:
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    process = context.Process(target=rollout_in_another_process, args=(queue,))
    process.start()
    theirs = queue.get(timeout=120)
    process.join()
    ours = roll_out(CyclicLoopEnv("killian_court", noise="typical"), bumping_actions(1000, 1)[:, 0], seed=11)
    assert ours[-1][-1]["collisions"] > 10
    assert_same(ours, theirs)


def test_different_seeds_differ_only_where_something_is_random() -> None:
    actions = bumping_actions(50, 1)[:, 0]
    assert_same(roll_out(CyclicLoopEnv("ring"), actions, 0), roll_out(CyclicLoopEnv("ring"), actions, 1))
    noisy = [roll_out(CyclicLoopEnv("ring", noise="typical"), actions, seed) for seed in (0, 1)]
    assert (noisy[0][0][0]["laser"] != noisy[1][0][0]["laser"]).any()


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


@pytest.mark.parametrize("map_name", ["ring", "dead_ends"])
def test_a_pickle_holds_no_room_for_steps_to_come(map_name: str) -> None:
    sizes = []
    actions = bumping_actions(80, 1)[:, 0]
    actions[:, :2] = (0.3, -0.2)
    for step_budget in (100, 1_000_000):
        env = CyclicLoopEnv(map_name, step_budget=step_budget)
        env.reset(seed=0)
        for action in actions[:70]:
            env.step(action)
        text = pickle.dumps(env)
        sizes.append(len(text))
        twin = pickle.loads(text)
        for action in actions[70:]:
            assert_same(env.step(action), twin.step(action))
        assert_same(env.trajectory(), twin.trajectory())
        assert_same(env.claims(), twin.claims())
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


@pytest.mark.parametrize("action_type", ["wheels", "twist"])
def test_out_of_range_actions_are_clipped(square_room: cyclic_env.FloorPlan, action_type: str) -> None:
    paths = []
    for scale in (1, 50, np.inf):
        env = CyclicLoopEnv(square_room, action_type=action_type)
        env.reset(seed=0)
        paths.append([env.step(scale * np.array([1, 1, -1, 1]))[-1]["x"] for _ in range(20)])
    assert paths[0] == paths[1] == paths[2]


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


def test_the_episode_truncates_at_the_step_budget() -> None:
    assert CyclicLoopEnv("killian_court").step_budget == pytest.approx(17_700, abs=100)
    env = CyclicLoopEnv("ring", step_budget=10)
    assert env.step_budget == 10
    rollout = roll_out(env, np.zeros((10, 4), np.float32), seed=0)
    assert [step[3] for step in rollout[1:11]] == [False] * 9 + [True]
