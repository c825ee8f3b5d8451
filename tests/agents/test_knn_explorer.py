"""The explorer: directions, groups and the vote as in the paper, its runs of shipped plans, and garbage."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

from agents.exploration.planner import PlannerConfig
from agents.knn.config import calibrated_thresholds, preset
from agents.knn.directions import EAST, NORTH, WEST, compass_direction, sector_features
from agents.knn.explorer import KnnExplorer
from agents.knn.loop_detector import AppearanceDetector
from agents.knn.policy import KnnPolicy
from agents.slam.keyframes import Keyframes, revisit_candidates
from agents.slam.tracker import DeadReckoningTracker
from cyclic_env import CyclicLoopEnv, CyclicLoopVectorEnv, FloorPlan
from cyclic_env.config import LaserConfig, RobotConfig
from cyclic_env.errors import ConfigError
from tests.helpers import refused

BEAMS = 180


def explore(
    name: str | FloorPlan, explorer: KnnPolicy | None = None, *, seed: int = 0, steps: int = 10**9, **settings: Any
) -> tuple[dict[str, Any], KnnExplorer]:
    """Run an episode to its end, or until nothing is left to explore; return the last info and the memory."""
    explorer = KnnPolicy() if explorer is None else explorer
    env = CyclicLoopEnv(name, **settings)
    observation, info = env.reset(seed=seed)
    state = None
    for _ in range(min(steps, env.step_budget)):
        action, state = explorer.predict(observation, state)
        observation, _, terminated, truncated, info = env.step(action)
        if terminated or truncated or state[0].done:
            break
    assert state is not None
    return info, state[0]


# Steps 1 to 5.


def test_a_wobble_does_not_change_the_direction() -> None:
    direction = compass_direction(math.radians(44), None)
    assert direction == EAST
    assert compass_direction(math.radians(54), direction) == EAST
    assert compass_direction(math.radians(56), direction) == NORTH


def test_north_west_north_gives_two_of_north_and_one_of_west() -> None:
    explorer, state = KnnPolicy(), None
    for degrees in (90, 90, 120, 180, 170, 100, 90):
        compass = [math.cos(math.radians(degrees)), math.sin(math.radians(degrees))]
        observation = {"laser": np.full(BEAMS, 3.0), "distance": np.zeros(1), "compass": np.array(compass)}
        _, state = explorer.predict(observation, state)
    assert state is not None
    assert state[0].indicators[NORTH] == 2
    assert state[0].indicators[WEST] == 1
    assert [group.name for group in state[0].groups] == ["N1", "W1", "N2"]


def test_properties_are_the_least_ranges_of_sectors_ahead_and_back() -> None:
    ranges = np.full(BEAMS, 9.9)
    ranges[0] = 2.2  # ahead: the middle sector
    ranges[45] = 4.1  # 90 degrees to the left: the last one ahead, the first one back
    ranges[90] = 6.0
    ahead, back = sector_features(ranges, 7, 0.5)
    assert ahead.tolist() == [20, 20, 20, 4, 20, 20, 8]
    assert back.tolist() == [8, 20, 20, 12, 20, 20, 20]


def test_looking_back_is_what_is_ahead_after_turning_round() -> None:
    ranges = np.random.default_rng(0).uniform(1, 12, BEAMS)
    turned = np.roll(ranges, -BEAMS // 2)
    np.testing.assert_array_equal(sector_features(ranges, 7, 0.5)[1], sector_features(turned, 7, 0.5)[0])


def test_only_places_that_were_left_and_are_a_way_back_count_as_returned_to() -> None:
    path = np.array([0.0, 5.0, 10.0, 15.0, 20.0, 24.0])
    assert revisit_candidates(path, path[-1], np.array([1.0, 5.0, 11.0, 5.0, 1.0, 0.0]), 20.1, 10.1).tolist() == [0]
    assert revisit_candidates(path, path[-1], np.array([1.0, 5.0, 9.0, 5.0, 1.0, 0.0]), 20.1, 10.1).tolist() == []
    assert (
        revisit_candidates(0.8 * path, 0.8 * path[-1], np.array([1.0, 5.0, 11.0, 5.0, 1.0, 0.0]), 20.1, 10.1).tolist()
        == []
    )


def voted(features: list[list[int]], groups: list[int], query: list[int]) -> int | None:
    """Return the row that the paper's detector finds visited, of rows of one direction in these groups."""
    keyframes = Keyframes(BEAMS, 3)
    for row, (values, group) in enumerate(zip([*features, query], [*groups, 99], strict=True)):
        keyframes.add(features=np.array([values, values]), group=group, direction=NORTH, step=row)
    config = preset("paper", sectors=3, measure="euclidean", threshold=0.4)
    return AppearanceDetector(config).detect(keyframes, DeadReckoningTracker(), np.zeros(keyframes.count)).step


def test_the_group_with_most_of_the_four_nearest_wins_with_its_nearest_row() -> None:
    features = [[5, 5, 5], [5, 5, 6], [5, 6, 5], [9, 9, 9], [5, 5, 5]]
    assert voted(features, [0, 0, 0, 0, 1], [5, 5, 5]) == 0
    assert voted(features, [0, 0, 0, 0, 1], [5, 6, 6]) == 1


def test_ties_go_to_the_nearest_row() -> None:
    assert voted([[5, 5, 6], [5, 5, 5], [7, 7, 7], [8, 8, 8]], [0, 1, 0, 1], [5, 5, 5]) == 1


def test_a_place_less_alike_than_the_threshold_is_new() -> None:
    assert voted([[1, 1, 1]], [0], [9, 9, 9]) is None


# What it does.


@pytest.mark.parametrize("name", ["ring", "figure_eight", "twin_rings", "chamfered", "office", "dead_ends"])
def test_it_sees_everything_and_closes_every_cycle_without_a_false_claim(name: str) -> None:
    info, memory = explore(name)
    assert (info["is_success"], info["false_claims"], info["cycles_closed"]) == (True, 0, info["cycles_total"])
    assert len(memory.claims) >= info["cycles_closed"]


def test_a_laser_of_half_a_turn_looks_around_and_closes_the_loop() -> None:
    laser = LaserConfig(field_of_view=math.pi)
    info, memory = explore("ring", KnnPolicy(preset("extended").fitted(laser, RobotConfig())), laser=laser)
    assert (info["is_success"], info["false_claims"], info["cycles_closed"]) == (True, 0, 1)
    assert (memory.keyframes.scan[0] > 0).mean() < 0.6
    assert (memory.keyframes.scan[-1] > 0).mean() > 0.9  # the panorama of the last metres


def test_it_finds_its_way_with_poor_noise() -> None:
    info, _ = explore("twin_rings", noise="poor")
    assert (info["is_success"], info["false_claims"]) == (True, 0)


def test_it_finds_its_way_with_typical_noise() -> None:
    info, memory = explore("twin_rings", noise="typical", seed=1)
    assert info["coverage"] > 0.95
    assert info["false_claims"] == 0
    assert len(memory.tracker.graph(memory.keyframes).edges) >= memory.keyframes.count - 1


@pytest.mark.parametrize("action_type", ["twist", "discrete"])
def test_it_drives_with_every_action_type(action_type: Any) -> None:
    info, _ = explore("ring", KnnPolicy(action_type=action_type), steps=300, action_type=action_type)
    assert info["coverage"] > 0.5


def test_rows_of_a_batch_are_explored_as_alone() -> None:
    env = CyclicLoopVectorEnv(3, "office", noise="typical", autoreset_mode="SAME_STEP")
    explorer, state = KnnPolicy(), None
    observation, _ = env.reset(seed=[5, 6, 7])
    batch = []
    start = np.ones(3, np.bool_)
    for _ in range(150):
        actions, state = explorer.predict(observation, state, start)
        batch.append(actions)
        start = np.zeros(3, np.bool_)
        observation, *_ = env.step(actions)
    alone = CyclicLoopEnv("office", noise="typical")
    one, _ = alone.reset(seed=6)
    memory = None
    for actions in batch:
        action, memory = explorer.predict(one, memory)
        np.testing.assert_array_equal(action, actions[1])
        one, *_ = alone.step(action)


# Garbage.

GARBAGE = {
    "all beams at maximum": {"laser": lambda rng, t: np.full(BEAMS, 12.0)},
    "all beams at zero": {"laser": lambda rng, t: np.zeros(BEAMS)},
    "random beams": {"laser": lambda rng, t: rng.uniform(0, 12, BEAMS)},
    "a compass stuck": {"compass": lambda rng, t: np.array([1.0, 0.0])},
    "a compass at random": {"compass": lambda rng, t: rng.uniform(-1, 1, 2)},
    "a compass at zero": {"compass": lambda rng, t: np.zeros(2)},
    "a distance that jumps a little": {"distance": lambda rng, t: 0.1 * t + rng.uniform(-5, 5, 1)},
    "a distance that jumps": {"distance": lambda rng, t: rng.uniform(-1e5, 1e5, 1)},
    "a distance stuck": {"distance": lambda rng, t: np.zeros(1)},
}


@pytest.mark.parametrize("kind", GARBAGE)
def test_garbage_neither_raises_nor_hangs_and_claiming_stops(kind: str) -> None:
    """After a while the sensors go wrong; a hundred steps later there are no claims any more."""
    rng = np.random.default_rng(0)
    env = CyclicLoopEnv("figure_eight")
    observation, _ = env.reset(seed=0)
    explorer, state, claims = KnnPolicy(), None, 0
    for step in range(900):
        if step >= 450:
            observation = {**observation, **{name: make(rng, step) for name, make in GARBAGE[kind].items()}}
        action, state = explorer.predict(observation, state)
        assert np.isfinite(action).all()
        claims += bool(step >= 550 and action[2] > 0)
        observation, _, terminated, _, _ = env.step(action)
        if terminated:
            break
    assert claims == 0


# Settings.


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"detector": "bth"}, "both"),
        ({"measure": "cosin"}, "cosine"),
        ({"order": "newest"}, "last in first out"),
        ({"neighbours": 0}, "neighbours is 0"),
        ({"sectors": 1.5}, "sectors is 1.5"),
        ({"rounding": -1.0}, "rounding is -1.0"),
        ({"threshold": 3.0}, "threshold is 3.0"),
        ({"neighbors": 3}, "neighbours"),
        ({"neighbours": 10**5000}, "neighbours is"),
        ({"match_scans": "False"}, "match_scans is 'False'"),
    ],
)
def test_settings_that_do_not_fit_are_refused_with_a_hint(changes: dict[str, Any], message: str) -> None:
    with refused(message, ConfigError):
        preset("extended", **changes)


def test_an_unknown_preset_a_wrong_component_and_what_is_no_config_are_refused() -> None:
    with refused("extended", ConfigError):
        preset("extend")
    with refused(r"PlannerConfig.patience is -1.0", ConfigError):
        PlannerConfig(patience=-1.0)
    with refused("expected an ExplorerConfig", ConfigError):
        KnnPolicy("paper")  # pyright: ignore[reportArgumentType]


def test_ranges_that_are_infinite_or_no_numbers_met_nothing() -> None:
    explorer, state, other = KnnPolicy(), None, None
    for _ in range(5):
        observation = {"distance": np.zeros((2, 1)), "compass": np.array([[1.0, 0.0]] * 2)}
        laser = np.full((2, BEAMS), 3.0)
        laser[:, 20:40] = 12.0
        odd = laser.copy()
        odd[:, 20:30], odd[:, 30:40] = np.inf, np.nan
        actions, state = explorer.predict({**observation, "laser": laser}, state)
        others, other = explorer.predict({**observation, "laser": odd}, other)
        np.testing.assert_array_equal(actions, others)


def test_components_settings_are_saved_with_the_rest() -> None:
    saved = asdict(preset("extended", planner=PlannerConfig(patience=5)))
    assert saved["planner"]["patience"] == 5.0
    assert saved["loops"]["gap"] == 20.1


def test_a_larger_slower_robot_keeps_off_walls_and_is_waited_for() -> None:
    usual = preset("extended")
    assert usual.fitted(LaserConfig(), RobotConfig()) == usual
    fitted = usual.fitted(LaserConfig(range_max=8.0), RobotConfig(radius=0.35, wheel_speed_max=0.6, dt=0.1))
    assert (fitted.range_max, fitted.dt) == (8.0, 0.1)
    assert fitted.planner.half_width == pytest.approx(usual.planner.half_width + 0.1)
    assert fitted.costmap.clearance == pytest.approx(usual.costmap.clearance + 0.1)
    assert fitted.planner.patience == 2 * usual.planner.patience


@pytest.mark.parametrize("text", ["", "[]", '{"measures": {}}', '{"measures": {"cosine": null}}'])
def test_damaged_thresholds_are_one_clear_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    monkeypatch.setattr("agents.knn.config.THRESHOLDS", tmp_path / "thresholds.json")
    (tmp_path / "thresholds.json").write_text(text)
    with pytest.raises(ConfigError, match=r"calibrate_thresholds.py"):
        calibrated_thresholds.__wrapped__()


def test_a_distance_meter_need_not_begin_at_zero() -> None:
    explorer = KnnPolicy()
    observation = {"laser": np.full(BEAMS, 3.0), "distance": np.array([1234.5]), "compass": np.array([1.0, 0.0])}
    _, state = explorer.predict(observation)
    _, state = explorer.predict({**observation, "distance": np.array([1234.7])}, state)
    np.testing.assert_allclose(state[0].tracker.pose, (0.2, 0.0, 0.0), atol=1e-9)
    assert not state[0].trusted_from


def test_an_open_hall_is_seen_to_its_ends_with_many_beams() -> None:
    hall = FloorPlan("hall", shapely.box(0, 0, 40, 40), (20, 20, 0))
    info, _ = explore(hall, laser={"num_beams": 1080})
    assert info["is_success"]
