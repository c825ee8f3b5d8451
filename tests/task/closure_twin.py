"""The truth about loop closures by brute force: `cyclic_env.task.loop_closure` must agree with it at every step.

Written from the definitions alone. Nothing is remembered but counts: every step looks at all earlier steps, all walls
and the whole loop of a claim once more. Signs and ranks are exact, windings are summed angles.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import pairwise
from typing import Literal

from cyclic_env.config import ClosureConfig
from cyclic_env.floor_plans import FloorPlan

Position = tuple[float, float]
Wall = tuple[float, float, float, float]
Claim = int | Literal["nearest"] | None
"""Nothing said, the step that the robot says to be back at, or only that it is back somewhere."""

ROUNDING = 1e-9
"""A cross product of metres smaller than this, square metres, might have the wrong sign and is computed exactly."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Truth:
    """What is true after a step: what happened in it, and sums over the episode.

    `claimed` is the step that a judged claim named, or that it was given; -1 where there is none.
    """

    revisit: bool = False
    fresh: bool = False
    claim_judged: bool = False
    claim_correct: bool = False
    claim_error_m: float = 0.0
    claimed: int = -1
    claims: int = 0
    false_claims: int = 0
    revisits: int = 0
    revisits_recognised: int = 0
    missed: int = 0
    new_cycle: int = 0
    cycles_closed: int = 0


def turn(a: Position, b: Position, c: Position) -> int:
    """Return 1 if a, b, c turn left, -1 if right, 0 if they lie on one line, exactly."""
    cross = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    if abs(cross) < ROUNDING:
        (ax, ay), (bx, by), (cx, cy) = (tuple(map(Fraction, point)) for point in (a, b, c))
        cross = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    return (cross > 0) - (cross < 0)


def segments_touch(a: Position, b: Position, c: Position, d: Position) -> bool:
    """Return whether the segments ab and cd have a point in common, ends included."""
    boxes_touch = all(max(min(a[i], b[i]), min(c[i], d[i])) <= min(max(a[i], b[i]), max(c[i], d[i])) for i in range(2))
    return boxes_touch and turn(a, b, c) * turn(a, b, d) <= 0 and turn(c, d, a) * turn(c, d, b) <= 0


def walls_near(walls: Sequence[Wall], p: Position, reach: float) -> list[Wall]:
    """Return the walls that come into the square of half side `reach`, and a little more, around p."""
    west, east, south, north = p[0] - reach - 1e-6, p[0] + reach + 1e-6, p[1] - reach - 1e-6, p[1] + reach + 1e-6
    return [
        (x1, y1, x2, y2)
        for x1, y1, x2, y2 in walls
        if not (
            (x1 < west and x2 < west)
            or (x1 > east and x2 > east)
            or (y1 < south and y2 < south)
            or (y1 > north and y2 > north)
        )
    ]


def line_of_sight(walls: Sequence[Wall], a: Position, b: Position) -> bool:
    """Return whether the straight line from a to b, both in free space, touches no wall."""
    return not any(segments_touch(a, b, wall[:2], wall[2:]) for wall in walls)


def windings(plan: FloorPlan, loop: Sequence[Position]) -> list[int]:
    """Return how often a closed polyline goes round the hole of each cycle, counter-clockwise, by summed angles."""
    numbers = []
    for cx, cy in plan.cycle_anchors.tolist():
        total = 0.0
        for (ax, ay), (bx, by) in zip(loop, [*loop[1:], loop[0]], strict=True):
            ax, ay, bx, by = ax - cx, ay - cy, bx - cx, by - cy
            total += math.atan2(ax * by - ay * bx, ax * bx + ay * by)
        laps = total / math.tau
        assert abs(laps - round(laps)) < 1e-6
        numbers.append(round(laps))
    return numbers


def rank(vectors: Sequence[Sequence[int]]) -> int:
    """Return how many of the vectors are linearly independent, in exact arithmetic."""
    rows = [[Fraction(value) for value in vector] for vector in vectors]
    found = 0
    for column in range(len(rows[0]) if rows else 0):
        pivot = next((i for i in range(found, len(rows)) if rows[i][column] != 0), None)
        if pivot is None:
            continue
        rows[found], rows[pivot] = rows[pivot], rows[found]
        for i in range(found + 1, len(rows)):
            factor = rows[i][column] / rows[found][column]
            rows[i] = [a - factor * b for a, b in zip(rows[i], rows[found], strict=True)]
        found += 1
    return found


def path_lengths(positions: Sequence[Position]) -> list[float]:
    """Return the way driven up to each step, metres."""
    lengths = [0.0]
    for (ax, ay), (bx, by) in pairwise(positions):
        lengths.append(lengths[-1] + math.sqrt((bx - ax) * (bx - ax) + (by - ay) * (by - ay)))
    return lengths


class ClosureTwin:
    """The positions of an episode on a plan, and what the definitions say about each pair of steps."""

    def __init__(self, plan: FloorPlan, positions: Sequence[Position], config: ClosureConfig | None = None) -> None:
        self.plan = plan
        self.walls: list[Wall] = [(x1, y1, x2, y2) for x1, y1, x2, y2 in plan.walls.tolist()]
        self.positions = [(float(x), float(y)) for x, y in positions]
        self.config = config or ClosureConfig()
        self.lengths = path_lengths(self.positions)
        self.vectors: list[list[int]] = []
        """Winding numbers of the loops that closed a new cycle so far."""

    def square(self, t: int, k: int) -> float:
        """Return the squared distance of two positions: compared without a root, which would round."""
        (ax, ay), (bx, by) = self.positions[t], self.positions[k]
        return (bx - ax) * (bx - ax) + (by - ay) * (by - ay)

    def sees(self, t: int, k: int, walls: Sequence[Wall]) -> bool:
        """Return whether p_k is in sight of p_t, or so near that it counts as that."""
        given = self.square(t, k) < self.config.sight_given**2
        return given or line_of_sight(walls, self.positions[t], self.positions[k])

    def same_place(self, t: int, k: int) -> bool:
        """Return whether p_t is within the radius and in sight of p_k."""
        return self.square(t, k) <= self.config.return_radius**2 and self.sees(t, k, self.walls)

    def came_back(self, t: int, k: int) -> bool:
        """Return whether the robot went far enough, and far enough away from p_t, between the steps k and t."""
        far_enough = self.lengths[t] - self.lengths[k] >= self.config.gap
        return far_enough and any(self.square(t, j) >= self.config.leave_radius**2 for j in range(t, k - 1, -1))

    def nearest(self, t: int) -> int | None:
        """Return the nearest step that t returns to, the earliest of equally near ones; None where there is none.

        It is the least k, by distance and k, for which `same_place` and `came_back` hold; the walls come last.
        """
        here, radius = self.positions[t], self.config.return_radius
        away = next((j for j in range(t, -1, -1) if self.square(t, j) >= self.config.leave_radius**2), -1)
        # Been away after k: it suffices that the last time away was not before k.
        squares = ((self.square(t, k), k) for k in range(away + 1))
        near = sorted((square, k) for square, k in squares if square <= radius**2)
        walls = walls_near(self.walls, here, radius)
        for _, k in near:
            if self.lengths[t] - self.lengths[k] >= self.config.gap and self.sees(t, k, walls):
                return k
        return None

    def judge(self, t: int, claim: Claim, now: Truth, since_judged: float) -> Truth:
        """Return `now` with the claim of step t judged; as it is where the claim is ignored."""
        if claim is None or since_judged < self.config.claim_spacing:
            return now
        k = self.nearest(t) if claim == "nearest" else claim
        if k is None or not self.same_place(t, k):
            return replace(
                now,
                claim_judged=True,
                claim_error_m=0.0 if k is None else math.sqrt(self.square(t, k)),
                claims=now.claims + 1,
                claimed=-1 if k is None else k,
                false_claims=now.false_claims + 1,
            )
        if not self.came_back(t, k):
            return now
        vector = windings(self.plan, self.positions[k : t + 1])
        new_cycle = rank([*self.vectors, vector]) > len(self.vectors)
        if new_cycle:
            self.vectors.append(vector)
        return replace(
            now,
            claim_judged=True,
            claim_correct=True,
            claim_error_m=math.sqrt(self.square(t, k)),
            claims=now.claims + 1,
            claimed=k,
            new_cycle=int(new_cycle),
            cycles_closed=len(self.vectors),
        )

    def truths(self, claims: Sequence[Claim], *, ends: bool = True) -> Iterator[Truth]:
        """Yield the truth after each step, given its claim; the first is that of step 1.

        Parameters
        ----------
        claims : sequence
            One a step: `claims[0]` is that of step 1.
        ends : bool
            Whether the last step ends the episode, so that an open event settles in it.
        """
        last_t = len(self.positions) - 1
        assert len(claims) == last_t
        now = Truth()
        judged_at = -math.inf
        correct: list[int] = []
        """Steps of the correct claims."""
        event: list[int] = []
        """Fresh steps of the open event."""
        counted: list[int] = []
        """Steps of the settled events that count."""
        for t in range(1, last_t + 1):
            revisit = self.nearest(t) is not None
            now = replace(
                now,
                revisit=revisit,
                claim_judged=False,
                claim_correct=False,
                claim_error_m=0.0,
                claimed=-1,
                missed=0,
                new_cycle=0,
            )
            fresh = revisit and self.is_new_ground(t, counted)
            goes_on = fresh and bool(event) and event[-1] == t - 1
            if event and not goes_on and self.lengths[t] - self.lengths[event[-1]] >= self.config.event_gap:
                now = self.settle(now, event, correct, counted)
                event = []
                fresh = revisit and self.is_new_ground(t, counted)
            if fresh:
                event.append(t)
            now = replace(self.judge(t, claims[t - 1], now, self.lengths[t] - judged_at), fresh=fresh)
            if now.claim_judged:
                judged_at = self.lengths[t]
            if now.claim_correct:
                correct.append(t)
            if ends and t == last_t and event:
                now = self.settle(now, event, correct, counted)
            yield now

    def is_new_ground(self, t: int, counted: list[int]) -> bool:
        """Return whether no step of a counted event is at the same place as step t."""
        return not any(self.same_place(t, k) for k in counted)

    def settle(self, now: Truth, event: list[int], correct: list[int], counted: list[int]) -> Truth:
        """Return `now` with the event settled; where it counts, its steps are added to the counted ones."""
        first, last = event[0], event[-1]
        if self.lengths[last] - self.lengths[first] < self.config.event_length_min:
            return now
        counted += range(first, last + 1)
        within = any(first <= claim <= last for claim in correct)
        before = any(
            claim < first and self.lengths[first] - self.lengths[claim] < self.config.claim_spacing for claim in correct
        )
        recognised = within or before
        return replace(
            now,
            revisits=now.revisits + 1,
            revisits_recognised=now.revisits_recognised + recognised,
            missed=now.missed + (not recognised),
        )
