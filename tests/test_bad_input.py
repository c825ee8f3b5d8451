"""What a user can get wrong: one clear error each, in one line, that says what to do."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest

from cyclic_env import CyclicLoopEnv, CyclicLoopError, CyclicLoopVectorEnv
from cyclic_env.config import LaserConfig, RobotConfig

BAD_SETTINGS: list[tuple[dict[str, Any], str]] = [
    ({"map_name": "kilian_court"}, "Did you mean 'killian_court'"),
    ({"map_name": 3}, "a map is a name, a path, a FloorPlan"),
    ({"map_name": []}, "not empty"),
    ({"noise": "tipical"}, "Did you mean 'typical'"),
    ({"noise": {"laser_sigm": 0.1}}, "Did you mean 'laser_sigma'"),
    ({"noise": {"laser_short": 0.6, "laser_max": 0.6}}, "at most 1"),
    ({"noise": {"laser_sigma": -1}}, "at least 0"),
    ({"noise": None}, "noise"),
    ({"action_type": "wheel"}, "Did you mean 'wheels'"),
    ({"render_mode": "rgb"}, "Did you mean 'rgb_array'"),
    ({"random_start": "yes"}, "True or False"),
    ({"step_budget": 0}, "whole number from 1"),
    ({"step_budget": 1.5}, "whole number from 1"),
    ({"step_budget": 10**12}, "whole number from 1"),
    ({"robot": {"radius": float("nan")}}, "RobotConfig.radius is nan"),
    ({"robot": {"radius": 5.0}}, "radius 5 m"),
    ({"robot": {"radius": 0.01}}, "substep"),
    ({"robot": {"wheels": 3}}, "unknown field of RobotConfig 'wheels'"),
    ({"robot": {"axle_track": 1e-18}}, "axle_track"),
    ({"robot": {"radius": 10**400}}, "radius"),
    ({"closure": {"return_radius": 1e-9}}, "return_radius"),
    ({"coverage": {"scan_spacing": 1e-19}}, "scan_spacing"),
    ({"robot": 3}, "expected a RobotConfig or a mapping"),
    ({"laser": {"num_beams": 180.0}}, "whole number"),
    ({"laser": {"range_max": 0}}, "more than 0"),
    ({"closure": {"leave_radius": 1.0}}, "leave_radius"),
    ({"coverage": {"complete": 2}}, "at most 1"),
    ({"reward": {"time": "x"}}, "RewardConfig.time"),
]


@pytest.mark.parametrize(("settings", "message"), BAD_SETTINGS, ids=[str(s) for s, _ in BAD_SETTINGS])
@pytest.mark.parametrize("face", [CyclicLoopEnv, CyclicLoopVectorEnv])
def test_a_bad_setting_is_one_clear_line_on_both_faces(face: Any, settings: dict[str, Any], message: str) -> None:
    with pytest.raises(CyclicLoopError, match=message) as caught:
        face(**{"map_name": "ring", **settings})
    assert "\n" not in str(caught.value)


def test_an_unknown_argument_is_refused() -> None:
    with pytest.raises(CyclicLoopError, match="Did you mean 'noise'"):
        gymnasium.make("CyclicLoop-v0", nose="ideal")


BAD_ACTIONS: list[tuple[str, Any, str]] = [
    ("wheels", np.zeros(3), "has shape"),
    ("wheels", np.zeros((1, 4)), "has shape"),
    ("wheels", np.array([0, np.nan, 0, 0]), "no NaN"),
    ("wheels", "forward", "not an array of numbers"),
    ("wheels", None, "action"),
    ("wheels", [1, [2], 3, 4], "not an array of numbers"),
    ("wheels", [10**400, 0, 0, 0], "not an array of numbers"),
    ("wheels", {"left": 1}, "not an array of numbers"),
    ("twist", np.array([np.nan, 0, 0, 0]), "no NaN"),
    ("discrete", np.array([5, 0]), "a drive from 0 to 4"),
    ("discrete", np.array([0, 2]), "0 or 1 for the claim"),
    ("discrete", np.array([-1, 0]), "a drive from 0 to 4"),
    ("discrete", np.array([0.5, 0]), "whole numbers"),
    ("discrete", np.array(3), "has shape"),
]


@pytest.mark.parametrize(("action_type", "action", "message"), BAD_ACTIONS, ids=[f"{t} {a}" for t, a, _ in BAD_ACTIONS])
def test_a_bad_action_is_refused_and_the_episode_goes_on(action_type: Any, action: Any, message: str) -> None:
    env = CyclicLoopEnv("ring", action_type=action_type)
    env.reset(seed=0)
    with pytest.raises(CyclicLoopError, match=message) as caught:
        env.step(action)
    assert "\n" not in str(caught.value)
    env.step(env.action_space.sample())


def test_an_infinite_action_is_clipped() -> None:
    env = CyclicLoopEnv("ring")
    env.reset(seed=0)
    *_, info = env.step(np.array([np.inf, np.inf, -np.inf, np.inf]))
    assert info["path_length_m"] > 0


def test_a_batch_of_actions_of_the_wrong_size_is_refused() -> None:
    env = CyclicLoopVectorEnv(3, "ring")
    env.reset(seed=0)
    with pytest.raises(CyclicLoopError, match="for 3 robots"):
        env.step(np.zeros((2, 4)))


def test_a_step_before_the_first_reset_is_refused() -> None:
    for env in (CyclicLoopEnv("ring"), CyclicLoopVectorEnv(1, "ring")):
        with pytest.raises(CyclicLoopError, match="call reset"):
            env.step(np.zeros((1, 4)))


def test_a_step_after_the_end_is_refused() -> None:
    env = CyclicLoopEnv("ring", step_budget=1)
    env.reset(seed=0)
    env.step(np.zeros(4))
    with pytest.raises(CyclicLoopError, match="call reset"):
        env.step(np.zeros(4))


def test_a_step_after_the_end_is_refused_where_the_vector_env_does_not_reset() -> None:
    env = CyclicLoopVectorEnv(2, "ring", step_budget=1, autoreset_mode="DISABLED")
    env.reset(seed=0)
    env.step(np.zeros((2, 4)))
    with pytest.raises(CyclicLoopError, match=r"rows \[0, 1\] have ended"):
        env.step(np.zeros((2, 4)))


BAD_STARTS: list[tuple[Any, str]] = [
    ((0.0, 0.0), "expected"),
    ("here", "expected"),
    ((np.nan, 0, 0), "finite"),
    ((1e9, 0, 0), "outside the building"),
]


@pytest.mark.parametrize(("start", "message"), BAD_STARTS)
@pytest.mark.parametrize("face", [CyclicLoopEnv, CyclicLoopVectorEnv])
def test_a_start_where_the_robot_cannot_stand_is_refused(face: Any, start: Any, message: str) -> None:
    env = face(map_name="ring")
    with pytest.raises(CyclicLoopError, match=message):
        env.reset(options={"start": start})


def test_an_unknown_reset_option_is_refused() -> None:
    with pytest.raises(CyclicLoopError, match="Did you mean 'start'"):
        CyclicLoopEnv("ring").reset(options={"strat": (0, 0, 0)})


@pytest.mark.parametrize("mask", [[True, False], np.zeros(2, bool), np.ones(3, bool), np.ones(2)])
def test_a_bad_reset_mask_is_refused(mask: Any) -> None:
    env = CyclicLoopVectorEnv(2, "ring")
    with pytest.raises(CyclicLoopError, match="2 bools"):
        env.reset(options={"reset_mask": mask})


@pytest.mark.parametrize("options", [5, "start", [1]])
def test_options_that_are_no_dict_are_refused(options: Any) -> None:
    for env in (CyclicLoopEnv("ring"), CyclicLoopVectorEnv(2, "ring")):
        with pytest.raises(CyclicLoopError, match="are a dict"):
            env.reset(options=options)


def test_a_refused_start_leaves_every_row_as_it_was() -> None:
    env = CyclicLoopVectorEnv(3, "ring")
    env.reset(seed=0)
    for _ in range(5):
        env.step(np.zeros((3, 4)))
    x, y, heading = env.floor_plan(0).start
    with pytest.raises(CyclicLoopError):
        env.reset(seed=1, options={"start": [(x, y, heading), (1e6, y, 0), (x, y, heading)]})
    assert env.engine.episodes.memory.status["steps"].tolist() == [5, 5, 5]
    assert env.np_random_seed == (0, 1, 2)


def test_questions_about_an_episode_before_the_first_one_are_refused() -> None:
    env = CyclicLoopEnv(["ring", "grid"])
    for question in (lambda: env.floor_plan, lambda: env.step_budget, env.trajectory, env.seen_cells):
        with pytest.raises(CyclicLoopError, match="call reset"):
            question()


def test_numpys_numbers_are_numbers() -> None:
    env = CyclicLoopVectorEnv(np.int64(2), "ring", step_budget=np.int32(5), robot={"radius": np.float32(0.3)})  # pyright: ignore[reportArgumentType]
    assert env.num_envs == 2


@pytest.mark.parametrize("seed", [1.5, "x"])
def test_a_seed_that_is_no_number_is_refused(seed: Any) -> None:
    with pytest.raises(CyclicLoopError, match="expected a whole number"):
        CyclicLoopVectorEnv(3, "ring").reset(seed=seed)


def test_seeds_that_do_not_fit_are_refused() -> None:
    with pytest.raises(CyclicLoopError, match="3 seeds were given for 2 rows"):
        CyclicLoopVectorEnv(2, "ring").reset(seed=[1, 2, 3])


@pytest.mark.parametrize("number", [0, -1, 2.5, True, "4"])
def test_a_bad_number_of_envs_is_refused(number: Any) -> None:
    with pytest.raises(CyclicLoopError, match="num_envs"):
        CyclicLoopVectorEnv(number, "ring")


def test_a_bad_autoreset_mode_is_refused() -> None:
    with pytest.raises(CyclicLoopError, match="autoreset mode 'SAMESTEP'"):
        CyclicLoopVectorEnv(1, "ring", autoreset_mode="SAMESTEP")


@pytest.mark.parametrize(("config", "field"), [(RobotConfig, "radius"), (LaserConfig, "num_beams")])
def test_settings_cannot_be_changed(config: Any, field: str) -> None:
    with pytest.raises(AttributeError):
        setattr(config(), field, 1)
