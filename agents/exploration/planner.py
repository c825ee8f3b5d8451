"""Where to go next, the way there, and how to drive it."""

from __future__ import annotations

import math

import numpy as np

from agents.exploration.costmap import Costmap
from agents.exploration.frontiers import DETOUR, Frontiers
from agents.exploration.visibility import clear_beam, clear_lengths
from agents.slam.keyframes import Keyframes, route
from agents.slam.se2 import euclidean_distances, wrap, wrap_all
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
    path : (m, 2) float64
        Points that are left of the way to it.
    """

    def __init__(self, beams: int) -> None:
        self.goal: np.ndarray | None = None
        self.path = np.zeros((0, 2))
        self._local = False
        self._costmap = Costmap()
        self._clear = np.zeros(beams)
        self._best_cost = math.inf  # cost of the way when there was progress last
        self._steps_stuck = 0

    def select_goal(
        self,
        pose: np.ndarray,
        scan: np.ndarray,
        keyframes: Keyframes,
        frontiers: Frontiers,
        geodesic_m: np.ndarray,
        predecessors: np.ndarray,
        order: np.ndarray | None = None,
    ) -> None:
        """Choose an open point to go to: the one at hand, or the cheapest if that is gone or far dearer.

        Parameters
        ----------
        pose : (3,)
        scan : (beams,)
        keyframes : Keyframes
        frontiers : Frontiers
        geodesic_m, predecessors : (n,)
            Of the ways from the last place; see `Keyframes.geodesic_distances`.
        order : (m,), optional
            Only points of the least value are chosen from; inf for those that are out of question.
        """
        points = frontiers.points(keyframes)
        if not len(points) or (order is not None and not np.isfinite(order).any()):
            self.goal = None
            return
        euclidean_m = euclidean_distances(points, pose)
        costs, cells = self._draw(pose, scan, keyframes, frontiers.range_max, geodesic_m).costs_to(points)
        local = np.isfinite(costs) & (geodesic_m[frontiers.keyframe] <= euclidean_m + DETOUR + MAP_REACH)
        costs = np.where(local, costs, geodesic_m[frontiers.keyframe] + frontiers.polar[:, 0] + FAR_COST)
        bearings = np.arctan2(points[:, 1] - pose[1], points[:, 0] - pose[0]) - pose[2]
        costs += TURN_COST * np.abs(wrap_all(bearings)) + KIND_COST[frontiers.polar[:, 2].astype(np.int64)]
        if order is not None:
            costs += np.where(order == order.min(), 0.0, np.inf)
        best = int(np.argmin(costs))
        if self.goal is not None:
            same = euclidean_distances(points, self.goal)
            mine = int(np.argmin(same))
            if (
                same[mine] < 0.3
                and np.isfinite(costs[mine])
                and costs[best] >= SWITCH_SHARE * costs[mine] - SWITCH_GAIN
            ):
                best = mine
        kept = self.goal is not None and euclidean_distances(points[best : best + 1], self.goal)[0] < 0.5
        if not kept or costs[best] < self._best_cost - 0.5:
            self._best_cost, self._steps_stuck = float(costs[best]), 0
        goal = self.goal = points[best]
        if kept and self._local and not local[best] and len(self.path):
            return  # the way is known, though its end is off the map now
        self._local = bool(local[best])
        if self._local:
            self.path = self._costmap.path_to(int(cells[best]))
        else:
            self.path = self._path_along(
                np.vstack([keyframes.pose[route(predecessors, int(frontiers.keyframe[best])), :2], goal])
            )

    def _path_along(self, spots: np.ndarray) -> np.ndarray:
        """Return the way `(m, 2)` along places `(n, 2)`, over the local map as far as it goes."""
        driven = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(spots, axis=0).T))])
        costs, cells = self._costmap.costs_to(spots)
        on_map = np.flatnonzero((driven < MAP_REACH) & np.isfinite(costs))
        if not len(on_map):
            return spots
        return np.vstack([self._costmap.path_to(int(cells[on_map[-1]])), spots[on_map[-1] + 1 :]])

    def _draw(
        self, pose: np.ndarray, scan: np.ndarray, keyframes: Keyframes, range_max: float, geodesic_m: np.ndarray
    ) -> Costmap:
        euclidean_m = euclidean_distances(keyframes.pose, pose)
        near = np.flatnonzero((euclidean_m < MAP_REACH) & (geodesic_m <= euclidean_m + DETOUR))
        spots = np.vstack([keyframes.pose[:, :2], pose[:2]])
        legs = np.stack([spots[near], spots[near + 1]], axis=1)
        near = near[np.argsort(euclidean_m[near], kind="stable")][: 2 * MAP_SCANS : 2]
        self._costmap.draw(
            pose, np.vstack([scan, keyframes.scan[near]]), np.vstack([pose, keyframes.pose[near]]), legs, range_max
        )
        return self._costmap

    def has_arrived(self, pose: np.ndarray) -> bool:
        """Tell whether the robot is at its goal."""
        return self.goal is not None and math.hypot(pose[0] - self.goal[0], pose[1] - self.goal[1]) < ARRIVES

    @property
    def gives_up(self) -> bool:
        """Whether the goal seems out of reach."""
        return self.goal is not None and self._steps_stuck > PATIENCE

    def clear_goal(self) -> None:
        """Have no goal any more."""
        self.goal, self._best_cost, self._steps_stuck = None, math.inf, 0

    def steer_along(self, pose: np.ndarray, scan: np.ndarray) -> tuple[float, float]:
        """Return speed and turning rate along the way, as shares of a full twist."""
        if self.goal is None:
            return 0.0, 0.0
        self._steps_stuck += 1
        clear_lengths(scan, HALF_WIDTH, self._clear)
        target, bearing, euclidean_m = look_ahead(self.path, pose, self._clear)
        self.path = self.path[target:]
        return steer(self._clear, bearing, euclidean_m, AVOIDS if self._steps_stuck < HESITATES else math.pi)


@compiled
def look_ahead(path, pose, clear):
    """Return the farthest point of a way `(m, 2)` to which the way is clear, its bearing and its distance.

    Points within reach of the robot are passed over; where no way is clear, the first point is taken.
    """
    spacing = 2 * math.pi / clear.shape[0]
    target = 0
    for k in range(path.shape[0]):
        dx, dy = path[k, 0] - pose[0], path[k, 1] - pose[1]
        euclidean_m = math.sqrt(dx * dx + dy * dy)
        beam = round((math.atan2(dy, dx) - pose[2]) / spacing) % clear.shape[0]
        if euclidean_m < LOOKAHEAD and euclidean_m < clear[beam] + 0.3:
            target = k
    dx, dy = path[target, 0] - pose[0], path[target, 1] - pose[1]
    if dx * dx + dy * dy < PASSED**2 and target < path.shape[0] - 1:
        target += 1
        dx, dy = path[target, 0] - pose[0], path[target, 1] - pose[1]
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
