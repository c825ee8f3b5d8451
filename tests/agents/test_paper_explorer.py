"""The preset `paper`: the paper's steps in the paper's order, and how it ends."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from agents import make_agent
from agents.knn.config import preset
from agents.knn.directions import EAST, NORTH
from agents.knn.explorer import KnnExplorer
from agents.knn.loop_detector import AppearanceDetector, CombinedDetector, Detection, LoopDetector, PositionDetector
from agents.knn.policy import KnnPolicy
from agents.slam.keyframes import Keyframes
from agents.slam.tracker import DeadReckoningTracker
from cyclic_env import CyclicLoopEnv, FloorPlan, map_names
from tests.agents.buildings import plan_of

PAPER = preset("paper")
BLOCK = plan_of((0, 0, 30, 2.4), (27.6, 0, 30, 22), (0, 19.6, 30, 22), (0, 0, 2.4, 22), (14, -34, 16.4, 2.4))
"""Corridors around a block, and a dead end to the south of the first one that is longer than the laser reaches."""


def explore(plan: str | FloorPlan, policy: KnnPolicy | None = None) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Run an episode; return the last info, and what there was to tell after each step."""
    env, policy = CyclicLoopEnv(plan), policy or KnnPolicy(PAPER)
    observation, info = env.reset(seed=0)
    state, log, ended = None, [], False
    while not ended:
        action, state = policy.predict(observation, state)
        explorer: KnnExplorer = state[0]
        observation, _, terminated, truncated, info = env.step(action)
        states = [area.state for area in explorer.frontiers.listed]
        log.append(
            {
                "indicators": sum(explorer.indicators),
                "groups": [group.name for group in explorer.groups],
                "rows": explorer.keyframes.count,
                "compared": explorer.detector.compared,
                "listed": len(states),
                "resolved": states.count("reached another way") + states.count("visited"),
                "claims": len(explorer.claims),
                "stop": explorer.stop_reason,
            }
        )
        ended = terminated or truncated or explorer.done
    return info, log


def first(log: list[dict[str, Any]], name: str, value: Any) -> int:
    """Return the first step at which a count has reached a value."""
    return next(step for step, entry in enumerate(log) if entry[name] >= value)


def test_the_steps_are_taken_in_the_papers_order() -> None:
    info, log = explore(BLOCK)
    # Steps 2 to 4 come first: the first direction raises its indicator, and its table gets rows (Step 1).
    assert log[0]["indicators"] == 1
    assert log[0]["groups"] == ["E1"]
    assert first(log, "indicators", 1) < first(log, "rows", 1)
    # Every change of direction raises one indicator by 1, and begins the table that is named after it.
    for entry in log:
        assert len(entry["groups"]) == entry["indicators"] == len(set(entry["groups"]))
    # Step 5: nothing is compared before a direction comes again, after 20 m; then the place is found to be known.
    second = next(step for step, entry in enumerate(log) if any(name.endswith("2") for name in entry["groups"]))
    assert second <= first(log, "compared", 1) <= first(log, "claims", 1)
    # The dead end was left open and listed before, and is gone to after the place was known (Step 6).
    assert first(log, "listed", 1) < first(log, "claims", 1) < len(log)
    assert log[-1]["resolved"] > log[first(log, "claims", 1) - 1]["resolved"]
    assert (info["is_success"], info["false_claims"]) == (True, 0)


def test_only_the_first_rows_of_a_group_are_compared() -> None:
    _, some = explore("ring")
    _, all_rows = explore("ring", KnnPolicy(preset("paper", asked_rows=None)))
    assert 0 < some[-1]["compared"] <= all_rows[-1]["compared"]


def found_by(
    kind: type[LoopDetector], query: float, likeness: tuple[int, int, int], direction: int, **changes: Any
) -> Detection:
    """Return what is found at `query` m east, with that appearance, after a way of 30 m there and back."""
    keyframes, path = Keyframes(180, 3), 0.0
    along = [*np.arange(0.0, 31.0), *np.arange(29.0, query - 0.5, -1.0)]
    for step, x in enumerate(along):
        path += 0.0 if step == 0 else 1.0
        features = np.array([[step % 7 + 1, 5, 9]] * 2)
        columns = {"pose": (x, 0.0, 0.0), "odometry": (x, 0.0), "path": path, "step": step, "features": features}
        keyframes.add(**columns, direction=EAST, group=step // 40)
    keyframes.features[-1], keyframes.direction[-1], keyframes.group[-1] = np.array([likeness] * 2), direction, 99
    detector = kind(preset("paper", sectors=3, threshold=0.999, **changes))
    return detector.detect(keyframes, DeadReckoningTracker(), path - keyframes.path)


def test_position_says_where_and_appearance_confirms() -> None:
    same, other = (4, 5, 9), (9, 1, 1)  # the fourth row, at 3 m, looks like the first; so do those at 10, 17 and 24 m
    assert found_by(CombinedDetector, 3.0, same, EAST).step == 3
    assert found_by(CombinedDetector, 3.0, other, EAST).step is None
    assert found_by(CombinedDetector, 3.0, same, NORTH).step is None
    assert found_by(CombinedDetector, 6.0, same, EAST).step is None  # the nearest that looks so is 3 m away
    assert found_by(PositionDetector, 3.0, other, NORTH).step == 3
    assert found_by(AppearanceDetector, 6.0, same, EAST).step is not None


def test_a_visited_place_is_joined_to_the_known_one() -> None:
    same = (4, 5, 9)
    assert found_by(CombinedDetector, 3.0, same, EAST).connects == 3
    assert found_by(CombinedDetector, 3.0, same, EAST, join=False).connects is None


@pytest.mark.parametrize("name", [name for name in map_names() if name != "killian_court"])
def test_with_ideal_sensors_it_succeeds_without_a_false_claim(name: str) -> None:
    info, log = explore(name)
    assert info["false_claims"] == 0
    assert info["is_success"], log[-1]


def test_its_readings_are_agents_by_name() -> None:
    for name, detector in (("knn_paper", "both"), ("knn_paper_appearance", "knn"), ("knn_paper_position", "position")):
        agent = make_agent(name)
        assert isinstance(agent, KnnPolicy)
        assert agent.config == preset("paper", detector=detector)


def test_it_says_why_it_stops() -> None:
    _, log = explore("figure_eight", KnnPolicy(preset("paper", detector="knn", unbounded_only=True, join=False)))
    assert log[-1]["stop"] == "only openings left that it doesn't go to"
