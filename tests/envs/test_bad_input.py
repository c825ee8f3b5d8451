"""What a user can get wrong: one clear error each, in one line, that says what to do."""

from __future__ import annotations

import copy
import math
import pickle
import subprocess
import sys
import threading
from decimal import Decimal
from fractions import Fraction
from typing import Any

import gymnasium
import numpy as np
import pytest
import shapely

from cyclic_env import CyclicLoopEnv, CyclicLoopError, CyclicLoopVectorEnv, FloorPlan
from cyclic_env.config import LaserConfig, RobotConfig
from cyclic_env.validation import short_repr

BAD_SETTINGS: list[tuple[dict[str, Any], str]] = [
    ({"map_name": "kilian_court"}, "Did you mean 'killian_court'"),
    ({"map_name": 3}, "a map is a name, a path, a FloorPlan"),
    ({"map_name": []}, "not empty"),
    ({"map_name": np.zeros(2000)}, "a map is a name"),
    ({"noise": "tipical"}, "Did you mean 'typical'"),
    ({"noise": {"laser_sigm": 0.1}}, "Did you mean 'laser_sigma'"),
    ({"noise": {"laser_short": 0.6, "laser_max": 0.6}}, "at most 1"),
    ({"noise": {"laser_sigma": -1}}, "at least 0"),
    ({"noise": []}, "expected a NoiseConfig or a mapping"),
    ({"noise": np.array(["ideal", "poor"])}, "expected a NoiseConfig or a mapping"),
    ({"action_type": "wheel"}, "Did you mean 'wheels'"),
    ({"action_type": ["wheels"]}, "unknown action type"),
    ({"action_type": np.array(["wheels", "twist"])}, "unknown action type"),
    ({"render_mode": "rgb"}, "Did you mean 'rgb_array'"),
    ({"render_mode": np.array(["human", "rgb_array"])}, "unknown render mode"),
    ({"render_mode": ["human"]}, "unknown render mode"),
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
    ({"robot": {"radius": 10**5000}}, "thousands of digits"),
    ({"robot": {"radius": np.zeros((40, 40))}}, "RobotConfig.radius is array"),
    ({"robot": {"radius": Decimal("0.3")}}, "RobotConfig.radius is Decimal"),
    ({"random_start": np.zeros((40, 40))}, "True or False"),
    ({"step_budget": 10**5000}, "thousands of digits"),
    ({"closure": {"return_radius": 1e-9}}, "return_radius"),
    ({"coverage": {"scan_spacing": 1e-19}}, "scan_spacing"),
    ({"robot": 3}, "expected a RobotConfig or a mapping"),
    ({"laser": {"num_beams": 180.0}}, "whole number"),
    ({"laser": {"range_max": 0}}, "more than 0"),
    ({"closure": {"leave_radius": 1.0}}, "leave_radius"),
    ({"coverage": {"complete": 2}}, "at most 1"),
    ({"reward": {"time": "x"}}, "RewardConfig.time"),
]


@pytest.mark.parametrize(("settings", "message"), BAD_SETTINGS, ids=[short_repr(s) for s, _ in BAD_SETTINGS])
@pytest.mark.parametrize("face", [CyclicLoopEnv, CyclicLoopVectorEnv])
def test_a_bad_setting_is_one_clear_line_on_both_faces(face: Any, settings: dict[str, Any], message: str) -> None:
    with pytest.raises(CyclicLoopError, match=message) as caught:
        face(**{"map_name": "ring", **settings})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("side", "cell_size", "message"), [(300, 0.05, "make cell_size larger"), (90_000, 0.5, "spans 90000 m x 90000 m")]
)
def test_a_building_too_large_for_its_cells_or_tiles_is_refused(side: float, cell_size: float, message: str) -> None:
    block = [(4, 4), (4, side - 4), (side - 4, side - 4), (side - 4, 4)]
    street = shapely.Polygon(shapely.box(0, 0, side, side).exterior, [block])
    with pytest.raises(CyclicLoopError, match=message):
        CyclicLoopEnv(FloorPlan("street", street, (2.0, 2.0, 0.0)), step_budget=10, coverage={"cell_size": cell_size})


@pytest.mark.parametrize("far", [1e300, np.inf, np.nan, -2e5])
def test_a_floor_plan_with_a_point_out_of_the_world_is_refused(far: float) -> None:
    with pytest.raises(CyclicLoopError, match="move the building to the origin"), np.errstate(all="ignore"):
        FloorPlan("far", shapely.Polygon([(0, 0), (10, 0), (10, far), (0, 10)]), (1.0, 1.0, 0.0))


def test_a_floor_plan_with_a_start_beyond_all_numbers_is_refused() -> None:
    with pytest.raises(CyclicLoopError, match=r"start must be finite \(x, y, heading\)"):
        FloorPlan("room", shapely.box(0, 0, 10, 10), (10**400, 1.0, 0.0))


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
    ("wheels", np.zeros(4, np.complex64), "its type is complex64"),
    ("wheels", np.array(["1", "1", "0", "0"]), "its type is <U1"),
    ("wheels", np.zeros(4, "datetime64[s]"), "its type is datetime64"),
    ("wheels", np.zeros(4, object), "its type is object"),
    ("wheels", 10**5000, "its type is object"),
    ("twist", np.array([np.nan, 0, 0, 0]), "no NaN"),
    ("discrete", np.array([5, 0]), "a drive from 0 to 4"),
    ("discrete", np.array([0, 2]), "0 or 1 for the claim"),
    ("discrete", np.array([-1, 0]), "a drive from 0 to 4"),
    ("discrete", np.array([0.5, 0]), "whole numbers"),
    ("discrete", np.array([2**64 - 4, 0], np.uint64), "a drive from 0 to 4"),
    ("discrete", np.array(3), "has shape"),
]


@pytest.mark.parametrize(
    ("action_type", "action", "message"), BAD_ACTIONS, ids=[f"{t} {short_repr(a)}" for t, a, _ in BAD_ACTIONS]
)
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
    with pytest.raises(CyclicLoopError, match=r"have shape \(2, 4\); expected \(3, 4\), a row for each robot"):
        env.step(np.zeros((2, 4)))
    with pytest.raises(CyclicLoopError, match=r"has shape \(5,\); expected \(4,\)"):
        env.step(np.zeros((3, 5)))


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
    ((10**400, 0, 0), "its type is object"),
    (("1", "2", "3"), "its type is <U1"),
    ((1j, 0, 0), "its type is complex128"),
    (np.full((40, 3), 0.123456789012345), "expected"),
    (np.array([np.longdouble(1), 2, np.inf]), "finite"),
]


@pytest.mark.parametrize(("start", "message"), BAD_STARTS)
@pytest.mark.parametrize("face", [CyclicLoopEnv, CyclicLoopVectorEnv])
def test_a_start_where_the_robot_cannot_stand_is_refused(face: Any, start: Any, message: str) -> None:
    env = face(map_name="ring")
    with pytest.raises(CyclicLoopError, match=message) as caught:
        env.reset(options={"start": start})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("face", [CyclicLoopEnv, CyclicLoopVectorEnv])
def test_a_tensor_with_a_gradient_is_refused_as_action_and_as_start(face: Any) -> None:
    torch = pytest.importorskip("torch")
    env = face(map_name="ring")
    with pytest.raises(CyclicLoopError, match="start is not an array of numbers"):
        env.reset(options={"start": torch.zeros(3, requires_grad=True)})
    env.reset(seed=0)
    with pytest.raises(CyclicLoopError, match="the action is not an array of numbers"):
        env.step(torch.zeros(env.action_space.shape, requires_grad=True))


def test_the_largest_start_headings_are_wrapped_exactly() -> None:
    env = CyclicLoopEnv("ring")
    x, y, _ = env.floor_plan.start
    for heading in (1e7, -1e15, 1e300, math.pi, -math.pi):
        *_, info = env.reset(options={"start": (x, y, heading)})
        assert -math.pi < info["heading"] <= math.pi
        assert math.remainder(info["heading"] - math.remainder(heading, math.tau), math.tau) == 0


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
    assert env.engine.steps.tolist() == [5, 5, 5]
    assert env.np_random_seed == (0, 1, 2)


POOL = ["ring", "office", "twin_rings"]
FAR = (1e6, 0.0, 0.0)


def test_a_refused_start_in_a_pool_leaves_both_faces_as_they_were() -> None:
    single, twin = CyclicLoopEnv(POOL), CyclicLoopEnv(POOL)
    vector, vector_twin = CyclicLoopVectorEnv(3, POOL), CyclicLoopVectorEnv(3, POOL)
    for env in (single, twin, vector, vector_twin):
        env.reset(seed=4)
    starts = [vector.floor_plan(0).start, vector.floor_plan(1).start, FAR]
    for seed in (None, 4):
        with pytest.raises(CyclicLoopError, match="outside the building"):
            single.reset(seed=seed, options={"start": FAR})
        with pytest.raises(CyclicLoopError, match="outside the building"):
            vector.reset(seed=seed, options={"start": starts})
    for env, like in ((single, twin), (vector, vector_twin)):
        actions = np.zeros(env.action_space.shape or ())
        assert str(env.step(actions)) == str(like.step(actions))
        assert str(env.reset()) == str(like.reset())
        assert env.np_random_seed == like.np_random_seed


def test_questions_about_an_episode_before_the_first_one_are_refused() -> None:
    env = CyclicLoopEnv(["ring", "grid"])
    for question in (lambda: env.floor_plan, lambda: env.step_budget, env.trajectory, env.claims, env.seen_cells):
        with pytest.raises(CyclicLoopError, match="call reset"):
            question()
    for question in (env.engine.claims, env.engine.trajectory, env.engine.seen_cells):
        with pytest.raises(CyclicLoopError, match="call reset"):
            question(0)


@pytest.mark.parametrize("render_mode", ["rgb_array", "human"])
@pytest.mark.parametrize("face", [CyclicLoopEnv, CyclicLoopVectorEnv])
def test_a_picture_before_the_first_reset_is_refused(face: Any, render_mode: str) -> None:
    with pytest.raises(CyclicLoopError, match="call reset"):
        face(map_name="ring", render_mode=render_mode).render()


@pytest.mark.parametrize("row", [2, -1, 1.0, "0", None, [0], np.zeros(2, int)])
def test_a_question_about_a_row_that_there_is_not_is_refused(row: Any) -> None:
    env = CyclicLoopVectorEnv(2, "ring")
    env.reset(seed=0)
    for question in (env.floor_plan, env.trajectory, env.claims, env.seen_cells, env.engine.claims):
        with pytest.raises(CyclicLoopError, match="a whole number from 0 to 1"):
            question(row)


def test_numpys_numbers_are_numbers() -> None:
    env = CyclicLoopVectorEnv(np.int64(2), "ring", step_budget=np.int32(5), robot={"radius": np.float32(0.3)})  # pyright: ignore[reportArgumentType]
    assert env.num_envs == 2


@pytest.mark.parametrize("number", [Fraction(1, 3), np.float32(0.3), np.longdouble(0.3)])
def test_numbers_of_other_types_give_the_same_bits(number: Any) -> None:
    steps = []
    for value in (number, float(number)):
        env = CyclicLoopEnv("ring", reward={"time": -value}, robot={"radius": value, "axle_track": value})
        env.reset(seed=0)
        steps.append(str([env.step(np.array([0.5, 0.3, -1, 0])) for _ in range(3)]))
    assert steps[0] == steps[1]


@pytest.mark.parametrize("seed", [1.5, "x", -1, np.float64(3), np.array([1.0, 2.0, 3.0]), {1, 2, 3}, {1: 2}, b"abc"])
@pytest.mark.parametrize("face", [CyclicLoopEnv, CyclicLoopVectorEnv])
def test_a_seed_that_is_no_whole_number_is_refused(face: Any, seed: Any) -> None:
    env = face(map_name="ring") if face is CyclicLoopEnv else face(3, "ring")
    with pytest.raises(CyclicLoopError, match="expected a whole number"):
        env.reset(seed=seed)


@pytest.mark.parametrize("seeds", [np.arange(3), range(3), (0, np.int64(1), np.uint8(2)), np.int32(0), np.array(0)])
def test_any_whole_numbers_are_seeds(seeds: Any) -> None:
    env = CyclicLoopVectorEnv(3, "ring")
    env.reset(seed=seeds)
    assert env.np_random_seed == (0, 1, 2)
    single = CyclicLoopEnv("ring")
    single.reset(seed=np.int64(7))  # pyright: ignore[reportArgumentType]
    assert single.np_random_seed == 7


def test_a_negative_seed_of_one_row_is_refused() -> None:
    with pytest.raises(CyclicLoopError, match="seed is -2"):
        CyclicLoopVectorEnv(2, "ring").reset(seed=[1, -2])


def test_seeds_that_do_not_fit_are_refused() -> None:
    with pytest.raises(CyclicLoopError, match="3 seeds were given for 2 rows"):
        CyclicLoopVectorEnv(2, "ring").reset(seed=[1, 2, 3])


@pytest.mark.parametrize("number", [0, -1, 2.5, True, "4", 10**9, np.ones((40, 40))])
def test_a_bad_number_of_envs_is_refused(number: Any) -> None:
    with pytest.raises(CyclicLoopError, match="num_envs") as caught:
        CyclicLoopVectorEnv(number, "ring")
    assert "\n" not in str(caught.value)


def test_robots_and_steps_beyond_the_memory_are_refused() -> None:
    with pytest.raises(CyclicLoopError, match="not enough memory for num_envs 1000000"):
        CyclicLoopVectorEnv(1_000_000, "ring", step_budget=10_000_000)


@pytest.mark.parametrize("mode", ["SAMESTEP", [], {}, np.array(["SAME_STEP", "x"]), None])
def test_a_bad_autoreset_mode_is_refused(mode: Any) -> None:
    with pytest.raises(CyclicLoopError, match="unknown autoreset mode"):
        CyclicLoopVectorEnv(1, "ring", autoreset_mode=mode)


def test_the_action_of_a_row_that_is_being_reset_is_ignored() -> None:
    env = CyclicLoopVectorEnv(2, "ring", step_budget=5, max_episode_steps=3)
    env.reset(seed=0, options={"reset_mask": np.array([True, False])})
    env.reset(seed=0, options={"reset_mask": np.array([False, True])})
    nonsense = np.array([[0.5, 0.5, -1, 0], [np.nan, np.inf, np.nan, np.nan]])
    for _ in range(3):
        env.step(nonsense[[0, 0]])
    env.reset(options={"reset_mask": np.array([True, False])})
    *_, infos = env.step(nonsense)  # row 1 is reset
    assert infos["path_length_m"][0] > 0
    assert infos["path_length_m"][1] == 0
    with pytest.raises(CyclicLoopError, match=r"robot 1 .* no NaN"):
        env.step(nonsense)


def test_threads_may_make_and_step_envs_of_their_own_on_the_same_plans() -> None:
    code = (
        "import threading; from cyclic_env import CyclicLoopVectorEnv\n"
        "def work(seed):\n"
        "    for _ in range(8):\n"
        "        env = CyclicLoopVectorEnv(9, ['killian_court', 'ring'], random_start=True); env.reset(seed=seed)\n"
        "        env.step(env.action_space.sample()); done.append(seed)\n"
        "done = []; threads = [threading.Thread(target=work, args=(seed,)) for seed in range(4)]\n"
        "[thread.start() for thread in threads]; [thread.join() for thread in threads]; print(len(done))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "32", result.stderr


@pytest.mark.parametrize("face", [CyclicLoopEnv, CyclicLoopVectorEnv])
@pytest.mark.parametrize("copied", [lambda env: env, copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_second_thread_in_an_env_is_refused(face: Any, copied: Any) -> None:
    env = face(map_name="ring")
    env.reset(seed=0)
    env = copied(env)
    actions = np.zeros(env.action_space.shape)
    refused: list[str] = []

    def intrude() -> None:
        for call in (lambda: env.step(actions), env.reset, env.close, lambda: copy.deepcopy(env)):
            try:
                call()
            except CyclicLoopError as error:
                refused.append(str(error))

    measure = env.engine.sensors.measure_rows

    def measure_while_another_thread_comes(*args: Any) -> None:
        thread = threading.Thread(target=intrude)
        thread.start()
        thread.join()
        measure(*args)

    env.engine.sensors.measure_rows = measure_while_another_thread_comes
    env.step(actions)
    assert len(refused) == 4
    assert all("already being stepped by another thread" in message for message in refused)
    del env.engine.sensors.measure_rows
    thread = threading.Thread(target=env.step, args=(actions,))
    thread.start()
    thread.join()
    env.step(actions)
    assert len(env.trajectory(*([0] if face is CyclicLoopVectorEnv else []))) == 4


@pytest.mark.parametrize(("config", "field"), [(RobotConfig, "radius"), (LaserConfig, "num_beams")])
def test_settings_cannot_be_changed(config: Any, field: str) -> None:
    with pytest.raises(AttributeError):
        setattr(config(), field, 1)
