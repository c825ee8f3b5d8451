"""Where to go next, the way there, and how to drive it."""

from __future__ import annotations

import math

import numpy as np

from agents.exploration.costmap import Costmap
from agents.exploration.frontiers import DETOUR, Frontiers
from agents.slam.keyframes import Keyframes, route
from agents.slam.scan_filters import clear_beam, clear_lengths
from agents.slam.se2 import distances, wrap, wrap_all
from cyclic_env.jit import compiled

HALF_WIDTH = 0.31
"""Metres: the robot's radius, and a little air."""
LOOKAHEAD = 3.0
"""Metres along its way that the robot cuts short at most; more would cut corners that the way goes round."""
PASSED = 0.6
"""Metres from a point of its way at which the robot makes for the next."""
AVOIDS, HESITATES = math.radians(60), 20
"""By which the robot turns off its way at most, for what is too near to it; and steps without progress after which it
turns off as far as it takes."""
TURN_COST = 1.5
"""Metres of way that a radian of turning is worth, so that the robot goes on rather than back."""
KIND_COST = np.array([0.0, 6.0, 0.0, 60.0])
"""Metres that an opening is put off by for its kind: a doubtful one is mostly a wall, and seen to be one in passing; an
unconfirmed one comes when all else within a loop's length is done."""
FAR_COST = 3.0
"""Metres that a goal off the local map is put off by."""
SWITCH_SHARE, SWITCH_GAIN = 0.4, 2.0
"""Another goal must cost less than this share of the one at hand, by so many metres more: no dithering."""
PATIENCE = 45
"""Steps without half a metre's progress after which a goal is given up: nine seconds."""
MAP_REACH = 12.0
"""Metres around the robot within which places' scans are drawn on the local map."""
MAP_SCANS = 20
"""Scans drawn at most."""
ARRIVES = 0.8
"""Metres from a goal at which the robot looks around."""


class Planner:
    """The goal of the moment, the way to it, and patience with it.

    Attributes
    ----------
    goal : (2,) float64 or None
        In the frame of the track.
    way : (m, 2) float64
        Points that are left of the way to it.
    """

    def __init__(self, beams: int) -> None:
        self.goal: np.ndarray | None = None
        self.way = np.zeros((0, 2))
        self._local = False
        self._map = Costmap()
        self._clear = np.zeros(beams)
        self._left = math.inf  # cost of the way when there was progress last
        self._waited = 0

    def choose(
        self,
        pose: np.ndarray,
        scan: np.ndarray,
        places: Keyframes,
        areas: Frontiers,
        lengths: np.ndarray,
        before: np.ndarray,
        order: np.ndarray | None = None,
    ) -> None:
        """Choose an open point to go to: the one at hand, or the cheapest if that is gone or far dearer.

        Parameters
        ----------
        pose : (3,)
        scan : (beams,)
        places : Keyframes
        areas : Frontiers
        lengths, before : (n,)
            Of the ways from the last place; see `Keyframes.ways_from`.
        order : (m,), optional
            Only points of the least value are chosen from; inf for those that are out of question.
        """
        points = areas.points(places)
        if not len(points) or (order is not None and not np.isfinite(order).any()):
            self.goal = None
            return
        away = distances(points, pose)
        costs, ends = self._draw(pose, scan, places, areas.range_max, lengths).ways_to(points)
        local = np.isfinite(costs) & (lengths[areas.place] <= away + DETOUR + MAP_REACH)
        costs = np.where(local, costs, lengths[areas.place] + areas.polar[:, 0] + FAR_COST)
        bearings = np.arctan2(points[:, 1] - pose[1], points[:, 0] - pose[0]) - pose[2]
        costs += TURN_COST * np.abs(wrap_all(bearings)) + KIND_COST[areas.polar[:, 2].astype(np.int64)]
        if order is not None:
            costs += np.where(order == order.min(), 0.0, np.inf)
        best = int(np.argmin(costs))
        if self.goal is not None:
            same = distances(points, self.goal)
            mine = int(np.argmin(same))
            if (
                same[mine] < 0.3
                and np.isfinite(costs[mine])
                and costs[best] >= SWITCH_SHARE * costs[mine] - SWITCH_GAIN
            ):
                best = mine
        kept = self.goal is not None and distances(points[best : best + 1], self.goal)[0] < 0.5
        if not kept or costs[best] < self._left - 0.5:
            self._left, self._waited = float(costs[best]), 0
        goal = self.goal = points[best]
        if kept and self._local and not local[best] and len(self.way):
            return  # the way is known, though its end is off the map now
        self._local = bool(local[best])
        if self._local:
            self.way = self._map.way_to(int(ends[best]))
        else:
            self.way = self._way_along(np.vstack([places.pose[route(before, int(areas.place[best])), :2], goal]))

    def _way_along(self, spots: np.ndarray) -> np.ndarray:
        """Return the way `(m, 2)` along places `(n, 2)`, over the local map as far as it goes."""
        driven = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(spots, axis=0).T))])
        costs, ends = self._map.ways_to(spots)
        on_map = np.flatnonzero((driven < MAP_REACH) & np.isfinite(costs))
        if not len(on_map):
            return spots
        return np.vstack([self._map.way_to(int(ends[on_map[-1]])), spots[on_map[-1] + 1 :]])

    def _draw(
        self, pose: np.ndarray, scan: np.ndarray, places: Keyframes, range_max: float, lengths: np.ndarray
    ) -> Costmap:
        away = distances(places.pose, pose)
        near = np.flatnonzero((away < MAP_REACH) & (lengths <= away + DETOUR))
        spots = np.vstack([places.pose[:, :2], pose[:2]])
        legs = np.stack([spots[near], spots[near + 1]], axis=1)
        near = near[np.argsort(away[near], kind="stable")][: 2 * MAP_SCANS : 2]
        self._map.draw(
            pose, np.vstack([scan, places.scan[near]]), np.vstack([pose, places.pose[near]]), legs, range_max
        )
        return self._map

    def arrives(self, pose: np.ndarray) -> bool:
        """Tell whether the robot is at its goal."""
        return self.goal is not None and math.hypot(pose[0] - self.goal[0], pose[1] - self.goal[1]) < ARRIVES

    @property
    def gives_up(self) -> bool:
        """Whether the goal seems out of reach."""
        return self.goal is not None and self._waited > PATIENCE

    def drop(self) -> None:
        """Have no goal any more."""
        self.goal, self._left, self._waited = None, math.inf, 0

    def drive(self, pose: np.ndarray, scan: np.ndarray) -> tuple[float, float]:
        """Return speed and turning rate along the way, as shares of a full twist."""
        if self.goal is None:
            return 0.0, 0.0
        self._waited += 1
        clear_lengths(scan, HALF_WIDTH, self._clear)
        target, bearing, away = look_ahead(self.way, pose, self._clear)
        self.way = self.way[target:]
        return steer(self._clear, bearing, away, AVOIDS if self._waited < HESITATES else math.pi)


@compiled
def look_ahead(way, pose, clear):
    """Return the farthest point of a way `(m, 2)` to which the way is clear, its bearing and its distance.

    Points within reach of the robot are passed over; where no way is clear, the first point is taken.
    """
    spacing = 2 * math.pi / clear.shape[0]
    target = 0
    for k in range(way.shape[0]):
        dx, dy = way[k, 0] - pose[0], way[k, 1] - pose[1]
        away = math.sqrt(dx * dx + dy * dy)
        beam = round((math.atan2(dy, dx) - pose[2]) / spacing) % clear.shape[0]
        if away < LOOKAHEAD and away < clear[beam] + 0.3:
            target = k
    dx, dy = way[target, 0] - pose[0], way[target, 1] - pose[1]
    if dx * dx + dy * dy < PASSED**2 and target < way.shape[0] - 1:
        target += 1
        dx, dy = way[target, 0] - pose[0], way[target, 1] - pose[1]
    bearing = math.atan2(dy, dx) - pose[2]
    bearing -= 2 * math.pi * math.floor((bearing + math.pi) / (2 * math.pi))
    return target, bearing, math.sqrt(dx * dx + dy * dy)


def steer(clear: np.ndarray, bearing: float, distance: float, avoids: float = math.pi) -> tuple[float, float]:
    """Return speed and turning rate, as shares of a full twist, towards a point that may be behind something.

    Parameters
    ----------
    clear : (beams,)
        As from `clear_lengths`.
    bearing, distance : float
        Of the point, radians and metres.
    avoids : float
        Radians by which to turn aside at most, for what is too near.
    """
    for need in (min(1.0, distance), 0.5):
        free = clear_beam(clear, bearing, need)
        if abs(wrap(free - bearing)) <= avoids:  # else, as between door posts, the way is trusted
            bearing = wrap(free)
            break
    turn = max(-1.0, min(1.0, 1.6 * bearing))
    # Turn on the spot when the way is off to the side or behind, and slow down for what is ahead.
    speed = math.cos(bearing) ** 4 if abs(bearing) < 1.2 else 0.0
    return speed * min(1.0, max(0.15, (clear[0] - 0.3) / 0.8)), 0.8 * turn
