"""Real drives on the shipped plans: the truth, the rewards, and the scores that the environment gives."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import shapely

from cyclic_env.config import ACTION_TYPES, ActionType, ClosureConfig, RobotConfig
from cyclic_env.envs.cyclic_loop import CyclicLoopEnv
from cyclic_env.floor_plans import FloorPlan, load_floor_plan, map_names
from cyclic_env.task.loop_closure import NEAREST
from cyclic_env.task.trajectory_truth import judge_trajectory
from tests.task.buildings import TWIN_FIELDS
from tests.task.closure_twin import Claim, ClosureTwin, Position, line_of_sight, rank

FAST_STEPS = RobotConfig(dt=0.4, substeps=10)
"""Control steps twice as long, so that tours of large buildings take fewer."""


@dataclass
class Drive:
    """What was driven and said, and what the environment answered."""

    plan: FloorPlan
    positions: list[Position] = field(default_factory=list)
    claims: list[Claim] = field(default_factory=list)
    infos: list[dict[str, Any]] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)
    ended: bool = False


class Hold:
    """Draws wheel speeds and keeps each for 15 steps: fast, slow, in circles, and into walls."""

    def __init__(self, plan: FloorPlan, rng: np.random.Generator) -> None:
        self.start = plan.start
        self.rng = rng
        self.steps = 0
        self.wheels = (0.0, 0.0)

    def __call__(self, x: float, y: float, heading: float) -> tuple[float, float]:
        if self.steps % 15 == 0:
            self.wheels = (float(self.rng.choice([0.4, 1.0, 1.0, -1.0])), float(self.rng.choice([0.4, 1.0, 1.0, -1.0])))
        self.steps += 1
        return self.wheels


class ToAndFro(Hold):
    """Drives forward and back again, 80 steps each."""

    def __call__(self, x: float, y: float, heading: float) -> tuple[float, float]:
        self.steps += 1
        return (1.0, 1.0) if self.steps % 160 < 80 else (-1.0, -1.0)


class Tour(Hold):
    """Follows the middles of the corridors by the true pose; at crossings mostly left, around the block."""

    def __init__(self, plan: FloorPlan, rng: np.random.Generator) -> None:
        super().__init__(plan, rng)
        self.next_to: dict[Position, set[Position]] = {}
        for part in shapely.get_parts(shapely.unary_union([shapely.LineString(line) for line in plan.centrelines])):
            for a, b in pairwise(part.coords):
                self.next_to.setdefault(a, set()).add(b)
                self.next_to.setdefault(b, set()).add(a)
        smallest_block = tuple(plan.cycle_anchors[-1]) if plan.cycles_total else plan.start[:2]
        self.last = min(self.next_to, key=lambda crossing: math.dist(crossing, smallest_block))
        self.goal = min(self.next_to[self.last], key=lambda crossing: math.dist(crossing, smallest_block))
        self.start = (*self.last, direction(self.last, self.goal))

    def __call__(self, x: float, y: float, heading: float) -> tuple[float, float]:
        if math.dist((x, y), self.goal) < 0.5:
            came = direction(self.last, self.goal)
            onward = sorted(
                self.next_to[self.goal] - {self.last} or {self.last},
                key=lambda crossing: math.remainder(direction(self.goal, crossing) - came, math.tau),
            )
            choice = -1 if self.rng.random() < 0.7 else self.rng.integers(len(onward))
            self.last, self.goal = self.goal, onward[choice]
        bearing = math.remainder(direction((x, y), self.goal) - heading, math.tau)
        if abs(bearing) > 0.4:
            swing = math.copysign(0.25, bearing)
            return -swing, swing
        return 0.8 - 0.3 * bearing, 0.8 + 0.3 * bearing


def direction(a: Position, b: Position) -> float:
    return math.atan2(b[1] - a[1], b[0] - a[0])


DRIVERS = {"hold": Hold, "to_and_fro": ToAndFro, "tour": Tour}
STEPS = {"hold": 350, "to_and_fro": 500, "tour": 1100}


def claim_match(env: CyclicLoopEnv, rng: np.random.Generator) -> float | None:
    """Return the match of a claim: often of the nearest earlier place, at times a random one; None for no claim."""
    kind = rng.random()
    if kind > 0.3:
        return None
    if kind < 0.02:
        return float(rng.choice([-1.0, 1.0]))
    if kind < 0.04:
        return float(rng.uniform(-1, 1))
    track = env.trajectory()
    distance = np.hypot(*(track[:, :2] - track[-1, :2]).T)
    distance[track[:, 2] > track[-1, 2] - 20] = np.inf
    k = int(distance.argmin())
    return 2 * k / len(track) - 1 if distance[k] < 3.2 else None


def wheels_action(action_type: str, left: float, right: float, match: float | None) -> np.ndarray:
    """Return the action of that type with those wheel speeds, as near as it can."""
    if action_type == "discrete":
        forward, swing = (left + right) / 2, right - left
        drive = (2 if swing > 0 else 3) if abs(swing) > 0.2 else 1 if forward > 0 else 4
        return np.array([drive, match is not None])
    if action_type == "twist":
        left, right = (left + right) / 2, (right - left) * 1.2 / 0.4 / 3.0
    return np.array([left, right, -1.0 if match is None else 1.0, match or 0.0], np.float32)


def claim_said(action_type: str, action: np.ndarray, t: int) -> Claim:
    """Return what the action says at step t, by the contract of the action spaces."""
    if action_type == "discrete":
        return "nearest" if action[1] else None
    return int(np.rint((float(action[3]) + 1) / 2 * t)) if action[2] > 0 else None


@cache
def drive(
    name: str, driver: str, action_type: ActionType, always_claim: bool = False, step_budget: int | None = None
) -> Drive:
    """Drive on a shipped plan until the budget is spent, or, always claiming at every step, until success."""
    plan, rng = load_floor_plan(name), np.random.default_rng(len(name))
    policy = DRIVERS[driver](plan, rng)
    env = CyclicLoopEnv(
        name,
        action_type=action_type,
        robot=FAST_STEPS if driver == "tour" else RobotConfig(),
        step_budget=step_budget or STEPS[driver],
        laser={"num_beams": 90, "range_max": 12.0 if always_claim else 0.3},  # too short to see all
    )
    _, info = env.reset(seed=0, options={"start": policy.start})
    result = Drive(plan, [(info["x"], info["y"])])
    while not result.ended:
        left, right = policy(info["x"], info["y"], info["heading"])
        match = 0.0 if always_claim else claim_match(env, rng)
        action = wheels_action(action_type, left, right, match)
        _, reward, terminated, truncated, info = env.step(action)
        result.positions.append((info["x"], info["y"]))
        result.claims.append(claim_said(action_type, action, len(result.positions) - 1))
        result.infos.append(info)
        result.rewards.append(float(reward))
        result.ended = terminated or truncated
    env.close()
    return result


DRIVES = [
    *(
        (name, driver, ACTION_TYPES[(i + j) % 3], False)
        for i, name in enumerate(map_names())
        for j, driver in enumerate(DRIVERS)
    ),
    *((name, "tour", "discrete", True) for name in map_names()),
]


@pytest.fixture(params=DRIVES, ids=lambda settings: "-".join(map(str, settings)))
def settings(request: pytest.FixtureRequest) -> Any:
    """The settings of every drive in turn."""
    return request.param


def test_truth_of_a_real_drive_equals_the_twin(settings: Any):
    done, missed = drive(*settings), 0
    twin = ClosureTwin(done.plan, done.positions)
    for t, (truth, info) in enumerate(zip(twin.truths(done.claims), done.infos, strict=True), 1):
        for key in TWIN_FIELDS.keys() - {"missed", "fresh"}:
            assert info[key] == getattr(truth, key), f"{key} differs first at step {t}"
        assert info["claim_error_m"] == pytest.approx(truth.claim_error_m, rel=0, abs=1e-9)
        missed += truth.missed
        assert info["revisits"] - info["revisits_recognised"] == missed


def test_reward_pays_for_what_happened(settings: Any):
    done = drive(*settings)
    before = dict.fromkeys(done.infos[0], 0)
    for info, reward in zip(done.infos, done.rewards, strict=True):
        new = {key: info[key] - before[key] for key in ("revisits", "revisits_recognised", "false_claims")}
        closed = info["cycles_closed"] - before["cycles_closed"]
        terms = info["reward_terms"]
        assert terms["missed_revisit"] == -1.0 * (new["revisits"] - new["revisits_recognised"])
        assert terms["false_claim"] == -5.0 * new["false_claims"]
        assert terms["new_cycle"] == pytest.approx(50.0 * closed / max(info["cycles_total"], 1))
        assert reward == pytest.approx(sum(terms.values()), abs=1e-12)
        before = info


def test_scores_follow_from_the_counts_and_the_steps(settings: Any):
    done = drive(*settings)
    for info in done.infos:
        recognised, settled = info["revisits_recognised"], info["revisits"]
        judged = recognised + info["false_claims"]
        assert info["precision"] == (recognised / judged if judged else 1.0)
        assert info["recall"] == (recognised / settled if settled else 1.0)
    assert done.infos[-1]["path_length_m"] == pytest.approx(sum(math.dist(a, b) for a, b in pairwise(done.positions)))


def test_open_event_settles_when_the_budget_is_spent():
    infos = drive("ring", "to_and_fro", "wheels").infos
    in_event = next(t for t, info in enumerate(infos, 1) if info["revisit"]) + 8
    last, before = drive("ring", "to_and_fro", "wheels", step_budget=in_event).infos[:-3:-1]
    assert (last["revisit"], last["revisits"] - before["revisits"]) == (True, 1)


def test_claiming_rightly_at_every_chance_recognises_every_event(settings: Any):
    done = drive(*settings)
    _, driver, _, always_claim = settings
    revisits = np.flatnonzero(judge_trajectory(done.plan, done.positions).revisit)
    judged = judge_trajectory(done.plan, done.positions, np.column_stack([revisits, np.full(len(revisits), NEAREST)]))
    assert (judged.recall, judged.precision, judged.false_claims) == (1.0, 1.0, 0)
    assert judged.revisits > 0 or driver != "tour" or always_claim  # then a lap of the ring is the end


# Nothing but going round counts ---------------------------------------------------------------------------------------


def loops_driven(plan: FloorPlan, positions: Sequence[Position], config: ClosureConfig) -> set[tuple[int, ...]]:
    """Return the winding numbers of every loop in the path that a line of sight within the radius closes."""
    points, anchors = np.array(positions), plan.cycle_anchors
    walls = ClosureTwin(plan, positions).walls
    angles = np.arctan2(points[:, None, 1] - anchors[:, 1], points[:, None, 0] - anchors[:, 0])
    turned = np.unwrap(angles, axis=0)  # no step turns by half a turn about an anchor, for these lie in the walls
    found: set[tuple[int, ...]] = set()
    for t, point in enumerate(points):
        near = np.flatnonzero(np.hypot(*(points[:t] - point).T) <= config.return_radius)
        for k, loop in zip(near, np.rint((turned[t] - turned[near]) / math.tau).astype(int).tolist(), strict=True):
            if tuple(loop) not in found and line_of_sight(walls, positions[t], positions[int(k)]):
                found.add(tuple(loop))
    return found


@pytest.mark.parametrize("name", map_names())
def test_claiming_all_the_time_closes_no_more_cycles_than_were_driven_round(name: str):
    done = drive(name, "tour", "discrete", always_claim=True)
    loops = loops_driven(done.plan, done.positions, ClosureConfig())
    assert done.infos[-1]["cycles_closed"] <= rank([list(loop) for loop in sorted(loops)])


@pytest.mark.parametrize("name", [name for name in map_names() if load_floor_plan(name).cycles_total])
def test_claiming_all_the_time_closes_a_cycle_where_there_is_one(name: str):
    assert drive(name, "tour", "discrete", always_claim=True).infos[-1]["cycles_closed"] > 0


@pytest.mark.parametrize("name", map_names())
def test_driving_to_and_fro_and_claiming_all_the_time_closes_no_cycle(name: str):
    assert drive(name, "to_and_fro", "discrete", always_claim=True).infos[-1]["cycles_closed"] == 0
