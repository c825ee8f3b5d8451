"""What users can get wrong with an environment: one clear line each, and the episode goes on."""

from __future__ import annotations

import copy
import math
import pickle
import subprocess
import sys
import threading
from typing import Any

import numpy as np
import pytest
import shapely

from cyclic_env import CyclicLoopEnv, CyclicLoopError, CyclicLoopVectorEnv, FloorPlan
from tests.helpers import refused

both_environments = pytest.mark.parametrize("env_class", [CyclicLoopEnv, CyclicLoopVectorEnv])


class TensorWithGradient:
    """Refuses to become an array, as PyTorch's does."""

    def __array__(self, *_: Any) -> Any:
        raise RuntimeError("Can't call numpy() on a Tensor that requires grad.\nUse tensor.detach().numpy() instead.")


@both_environments
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"map_name": "kilian_court"}, "Did you mean 'killian_court'"),
        ({"map_name": 3}, "a map is a name, a path, a FloorPlan"),
        ({"nose": "ideal"}, "Did you mean 'noise'"),
        ({"laser": {"num_beams": 0}}, "num_beams"),
        ({"robot": {"radius": 5.0}}, "radius 5 m"),
        ({"render_mode": "rgb"}, "Did you mean 'rgb_array'"),
    ],
)
def test_a_bad_argument_is_refused_in_one_line(env_class: Any, arguments: dict[str, Any], message: str) -> None:
    with refused(message):
        env_class(**{"map_name": "ring", **arguments})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_envs": 0}, "num_envs"),
        ({"num_envs": 1_000_000, "step_budget": 10_000_000}, "not enough memory for num_envs 1000000"),
        ({"num_threads": 0}, "num_threads"),
        ({"max_episode_steps": 0}, "max_episode_steps"),
        ({"autoreset_mode": "SAMESTEP"}, "unknown autoreset mode"),
    ],
)
def test_a_bad_argument_of_the_vector_env_is_refused(arguments: dict[str, Any], message: str) -> None:
    with refused(message):
        CyclicLoopVectorEnv(**{"map_name": "ring", **arguments})


@pytest.mark.parametrize(
    ("side", "cell_size", "message"), [(300, 0.05, "make cell_size larger"), (90_000, 0.5, "spans 90000 m x 90000 m")]
)
def test_a_building_too_large_for_its_cells_or_tiles_is_refused(side: float, cell_size: float, message: str) -> None:
    block = [(4, 4), (4, side - 4), (side - 4, side - 4), (side - 4, 4)]
    street = shapely.Polygon(shapely.box(0, 0, side, side).exterior, [block])
    with refused(message):
        CyclicLoopEnv(FloorPlan("street", street, (2.0, 2.0, 0.0)), step_budget=10, coverage={"cell_size": cell_size})


@pytest.mark.parametrize("far", [1e300, np.inf, np.nan, -2e5])
def test_a_floor_plan_with_a_point_out_of_the_world_is_refused(far: float) -> None:
    with refused("move the building to the origin"), np.errstate(all="ignore"):
        FloorPlan("far", shapely.Polygon([(0, 0), (10, 0), (10, far), (0, 10)]), (1.0, 1.0, 0.0))


@pytest.mark.parametrize(
    ("action_type", "action", "message"),
    [
        ("wheels", np.zeros(3), "has shape"),
        ("wheels", np.array([0, np.nan, 0, 0]), "no NaN"),
        ("wheels", [1, [2], 3, 4], "not an array of numbers"),
        ("wheels", TensorWithGradient(), "requires grad"),
        ("discrete", np.array([5, 0]), "a drive from 0 to 4"),
        ("discrete", np.array([0, 2]), "0 or 1 for the claim"),
        ("discrete", np.array([0.5, 0]), "whole numbers"),
    ],
)
def test_a_bad_action_is_refused_and_the_episode_goes_on(action_type: str, action: Any, message: str) -> None:
    env = CyclicLoopEnv("ring", action_type=action_type)
    env.reset(seed=0)
    with refused(message):
        env.step(action)
    env.step(env.action_space.sample())


def test_a_batch_of_actions_of_the_wrong_size_is_refused() -> None:
    env = CyclicLoopVectorEnv(3, "ring")
    env.reset(seed=0)
    for shape, message in (((2, 4), r"have shape \(2, 4\); expected 3 rows"), ((3, 5), r"has shape \(5,\)")):
        with refused(message):
            env.step(np.zeros(shape))


@both_environments
def test_steps_pictures_and_questions_before_the_first_reset_are_refused(env_class: Any) -> None:
    env = env_class(map_name=["ring", "grid"], render_mode="rgb_array")
    row = () if env_class is CyclicLoopEnv else (0,)
    questions = [lambda: env.step(np.zeros((1, 4))), env.render]
    questions += [lambda name=name: getattr(env, name)(*row) for name in ("trajectory", "claims", "seen_cells")]
    if env_class is CyclicLoopEnv:
        questions += [lambda: env.floor_plan, lambda: env.step_budget]
    else:
        questions += [lambda: env.floor_plan(0), lambda: env.step_budget(0)]
    for question in questions:
        with refused("call reset"):
            question()


def test_a_step_after_the_end_is_refused() -> None:
    single = CyclicLoopEnv("ring", step_budget=1)
    vector = CyclicLoopVectorEnv(2, "ring", step_budget=1, autoreset_mode="DISABLED")
    for env, message in ((single, "call reset"), (vector, r"rows \[0, 1\] have ended")):
        actions = np.zeros(env.action_space.shape or ())
        env.reset(seed=0)
        env.step(actions)
        with refused(message):
            env.step(actions)


@pytest.mark.parametrize("row", [2, -1, 1.0, "0", None, np.zeros(2, int)])
def test_a_question_about_a_row_that_does_not_exist_is_refused(row: Any) -> None:
    env = CyclicLoopVectorEnv(2, "ring")
    env.reset(seed=0)
    for question in (env.floor_plan, env.step_budget, env.trajectory, env.claims, env.seen_cells):
        with refused("a whole number from 0 to 1"):
            question(row)


@both_environments
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([1], "are a dict"),
        ({"strat": (0, 0, 0)}, "Did you mean 'start'"),
        ({"start": (0.0, 0.0)}, "expected"),
        ({"start": (np.nan, 0, 0)}, "finite"),
        ({"start": (1e9, 0, 0)}, "outside the building"),
        ({"start": TensorWithGradient()}, "requires grad"),
    ],
)
def test_bad_options_of_a_reset_are_refused(env_class: Any, options: Any, message: str) -> None:
    env = env_class(map_name="ring")
    with refused(message):
        env.reset(options=options)


@pytest.mark.parametrize("mask", [[True, False], np.zeros(2, bool), np.ones(3, bool), np.ones(2)])
def test_a_bad_reset_mask_is_refused(mask: Any) -> None:
    env = CyclicLoopVectorEnv(2, "ring")
    with refused("2 bools"):
        env.reset(options={"reset_mask": mask})


def test_a_refused_start_leaves_everything_as_it_was() -> None:
    pool, far = ["ring", "office", "twin_rings"], (1e6, 0.0, 0.0)
    single, single_twin = CyclicLoopEnv(pool), CyclicLoopEnv(pool)
    vector, vector_twin = CyclicLoopVectorEnv(3, pool), CyclicLoopVectorEnv(3, pool)
    for env in (single, single_twin, vector, vector_twin):
        env.reset(seed=4)
    starts = [vector.floor_plan(0).start, vector.floor_plan(1).start, far]
    for seed in (None, 4):
        with refused("outside the building"):
            single.reset(seed=seed, options={"start": far})
        with refused("outside the building"):
            vector.reset(seed=seed, options={"start": starts})
    for env, twin in ((single, single_twin), (vector, vector_twin)):
        actions = np.zeros(env.action_space.shape or ())
        assert str(env.step(actions)) == str(twin.step(actions))
        assert str(env.reset()) == str(twin.reset())
        assert env.np_random_seed == twin.np_random_seed


def test_the_largest_start_headings_are_wrapped_exactly() -> None:
    env = CyclicLoopEnv("ring")
    x, y, _ = env.floor_plan.start
    for heading in (1e7, -1e15, 1e300, math.pi, -math.pi):
        *_, info = env.reset(options={"start": (x, y, heading)})
        assert -math.pi < info["heading"] <= math.pi
        assert math.remainder(info["heading"] - math.remainder(heading, math.tau), math.tau) == 0


@both_environments
@pytest.mark.parametrize("seed", [1.5, "x", -1, np.array([1.0]), {1: 2}])
def test_a_seed_that_is_not_a_whole_number_is_refused(env_class: Any, seed: Any) -> None:
    with refused("expected a whole number"):
        env_class(map_name="ring").reset(seed=seed)


def test_seeds_of_the_rows_are_whole_numbers_and_one_for_each() -> None:
    env = CyclicLoopVectorEnv(3, "ring")
    for seeds in (np.arange(3), range(3), (0, np.int64(1), np.uint8(2)), np.int32(0), np.array(0)):
        env.reset(seed=seeds)  # pyright: ignore[reportArgumentType]
        assert env.np_random_seed == (0, 1, 2)
    for seeds, message in (([1, -2, 3], "seed is -2"), ([1, 2], "2 seeds were given for 3 rows")):
        with refused(message):
            env.reset(seed=seeds)


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
    with refused(r"robot 1 .* no NaN"):
        env.step(nonsense)


def test_threads_may_make_and_step_envs_of_their_own_on_the_same_plans() -> None:
    code = (
        "import threading; from cyclic_env import CyclicLoopVectorEnv\n"
        "def work(seed):\n"
        "    for _ in range(3):\n"
        "        env = CyclicLoopVectorEnv(9, ['killian_court', 'ring'], random_start=True); env.reset(seed=seed)\n"
        "        env.step(env.action_space.sample()); done.append(seed)\n"
        "done = []; threads = [threading.Thread(target=work, args=(seed,)) for seed in range(4)]\n"
        "[thread.start() for thread in threads]; [thread.join() for thread in threads]; print(len(done))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "12", result.stderr


@both_environments
@pytest.mark.parametrize("copied", [lambda env: env, copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_second_thread_in_an_env_is_refused(env_class: Any, copied: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    env = env_class(map_name="ring")
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

    def run_in_another_thread(work: Any, *arguments: Any) -> None:
        thread = threading.Thread(target=work, args=arguments)
        thread.start()
        thread.join()

    measure = env.engine.sensors.measure_rows

    def measure_while_another_thread_comes(*arguments: Any) -> None:
        run_in_another_thread(intrude)
        measure(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(env.engine.sensors, "measure_rows", measure_while_another_thread_comes)
        env.step(actions)
    assert len(refused) == 4
    assert all("already being stepped by another thread" in message for message in refused)
    run_in_another_thread(env.step, actions)
    env.step(actions)
    assert len(env.trajectory(*([0] if env_class is CyclicLoopVectorEnv else []))) == 4
