"""Looking again when no opening is left: places seen from afar, narrow passages, goals given up, laps not driven."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import shapely

from agents.exploration.building_map import BuildingMap, BuildingMapConfig
from agents.exploration.costmap import CostmapConfig
from agents.exploration.frontiers import Frontiers
from agents.exploration.survey import Survey, SurveyConfig
from agents.exploration.visibility import VisibilityConfig
from agents.knn.config import preset
from agents.knn.explorer import KnnExplorer
from agents.knn.policy import KnnPolicy
from cyclic_env import CyclicLoopEnv, FloorPlan
from cyclic_env.floor_plans import trace_floor_plan
from tests.agents.buildings import BEAMS, REACH, ROOM, keyframes_at, plan_of
from tests.helpers import load_script

CORNER_DOOR = FloorPlan(
    "corner_door",
    plan_of((0, 0, 12, 12), (0, 11.9, 0.9, 12.3), (0, 12.2, 14, 14.4)).free_space,
    (10.5, 1.0, 0.0),
)
"""A room of 12 m with a door of 0.9 m in its corner, seen from the far one, where three beams pass through it."""
NARROW = plan_of((0, 0, 6, 5), (5.9, 2.2, 8, 2.76), (7.9, 2.2, 8.9, 4), (7.9, 3.5, 14, 8))
"""Two rooms, and between them a passage of 0.56 m that bends. The robot is 0.5 m wide."""
RING = FloorPlan("ring", shapely.box(0, 0, 15, 15).difference(shapely.box(2, 2, 13, 13)), (1.0, 1.0, 0.0))  # pyright: ignore[reportArgumentType]


def explore(
    plan: FloorPlan, preset_name: str = "extended", coverage: float = math.inf, **changes: Any
) -> tuple[dict[str, Any], KnnExplorer, int]:
    """Run an episode to its end, or until so much has been seen.

    Return the last info, the explorer, and the step at which nothing was left open for the first time.
    """
    env, policy, done = CyclicLoopEnv(plan), KnnPolicy(preset(preset_name, **changes)), 0
    observation, info = env.reset(seed=0)
    state = None
    for step in range(env.step_budget):
        action, state = policy.predict(observation, state)
        observation, _, terminated, _, info = env.step(action)
        done = done or step * state[0].done
        if terminated or info["coverage"] >= coverage:
            break
    assert state is not None
    return info, state[0], done


@pytest.mark.parametrize(
    "plan", [CORNER_DOOR, NARROW], ids=["a door in the far corner", "a passage as wide as the robot"]
)
def test_what_was_missed_is_found_after_the_list_is_empty(plan: FloorPlan) -> None:
    info, _, done = explore(plan)
    assert info["is_success"]
    assert done
    info, explorer, done = explore(plan, look_again=False)
    assert not info["is_success"]
    assert explorer.stop_reason == "list empty"


@pytest.mark.slow
def test_a_room_of_a_drawn_map_is_left_through_the_door_in_its_corner() -> None:
    plan = trace_floor_plan(load_script("make_ros_maps").corner_doors()).plan
    info, _, done = explore(replace(plan, start=(11.5, -12.7, 1.57)), coverage=0.5)
    assert info["coverage"] >= 0.5
    assert 0 < done < 100


def test_the_papers_explorer_stops_when_its_list_is_empty() -> None:
    info, explorer, _ = explore(NARROW, "paper")
    assert explorer.done
    assert info["path_length_m"] < 2.0
    assert explorer.survey is None


def test_it_goes_on_until_the_budget_ends() -> None:
    """What is left is a closet behind a slit, which the robot can neither enter nor see into."""
    closet = plan_of((0, 0, 12, 7), (11.9, 6.7, 13, 6.9), (12.8, 5.6, 13.8, 6.9))
    info, explorer, done = explore(closet)
    assert not info["is_success"]
    assert 0 < done < 100
    assert info["path_length_m"] > 60.0
    assert explorer.survey is not None
    assert explorer.survey.round > 1


def test_a_point_that_was_given_up_is_listed_again() -> None:
    keyframes, frontiers = keyframes_at(plan_of((0, 0, 30, 2.4)), [(13.0, 1.2, 0.0)]), Frontiers(BEAMS, REACH)
    frontiers.update(keyframes, np.zeros(1))
    before = frontiers.points(keyframes)
    while len(frontiers):
        frontiers.blacklist(keyframes, frontiers.points(keyframes)[0])
    frontiers.reopen(keyframes, VisibilityConfig())
    np.testing.assert_allclose(frontiers.points(keyframes), before)


def around() -> list[tuple[float, float, float]]:
    """Return poses every metre along the corridors of `RING`."""
    corners = np.array([(1, 1), (14, 1), (14, 14), (1, 14), (1, 1)], float)
    sides = [np.linspace(start, end, 13, endpoint=False) for start, end in pairwise(corners)]
    return [(float(x), float(y), 0.0) for side in sides for x, y in side]


def test_a_lap_is_open_until_a_claim_has_closed_it() -> None:
    poses = around()
    keyframes = keyframes_at(RING, [*poses, poses[0]])
    building = BuildingMap(keyframes, REACH, CostmapConfig())
    ((inside, lap),) = building.open_laps(keyframes, [], keyframes.pose[0])
    assert shapely.box(2, 2, 13, 13).contains(shapely.Point(inside))
    assert shapely.Polygon(lap).contains(shapely.box(2, 2, 13, 13))
    assert 44 < shapely.LineString(lap).length < 56
    there_and_back = [(10, 4)]
    assert len(building.open_laps(keyframes, there_and_back, keyframes.pose[0])) == 1
    for before in (0, int(keyframes.step[0]) - 1):  # the latter is a step before the first keyframe
        assert building.open_laps(keyframes, [(keyframes.count, before)], keyframes.pose[0]) == []


def test_a_pillar_has_no_lap_that_counts() -> None:
    hall = FloorPlan("hall", ROOM.free_space.difference(shapely.box(4, 2, 6, 4)), (1.0, 1.0, 0.0))  # pyright: ignore[reportArgumentType]
    keyframes = keyframes_at(hall, [(1, 1, 0), (9, 1, 0), (9, 5, 0), (1, 5, 0)])
    building = BuildingMap(keyframes, REACH, CostmapConfig())
    assert building.open_laps(keyframes, [], keyframes.pose[0]) == []


def test_the_survey_leads_all_the_way_round_a_lap() -> None:
    keyframes = keyframes_at(RING, around())
    survey = Survey(BEAMS, REACH, SurveyConfig(), BuildingMapConfig(), CostmapConfig())
    pose, visited = keyframes.pose[-1].copy(), []
    assert survey.update(keyframes, [], pose)  # the first round begins
    while not survey.update(keyframes, [], pose):
        (point,) = survey.points(keyframes)
        pose[:2] = point
        visited.append(point)
    assert shapely.Polygon(visited).contains(shapely.box(2.5, 2.5, 12.5, 12.5))
    assert np.hypot(*np.diff(visited, axis=0).T).max() < 5.0


def test_the_nearest_place_that_was_only_seen_from_afar_comes_first() -> None:
    keyframes = keyframes_at(plan_of((0, 0, 30, 2.4)), [(4.0, 1.2, 0.0), (5.0, 1.2, 0.0)])
    building = BuildingMap(keyframes, REACH, CostmapConfig())
    place = building.hardly_seen(keyframes.pose[-1], keyframes.pose[:, :2], 4.0)
    assert place is not None
    assert 8.0 < place[0] < 10.0
    assert building.hardly_seen(keyframes.pose[-1], keyframes.pose[:, :2], 40.0) is None
