"""The planner: it chooses where to go next, finds the path there, and drives along it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from agents.component_config import ComponentConfig
from agents.exploration.costmap import Costmap
from agents.exploration.frontiers import Frontiers
from agents.exploration.survey import Survey
from agents.exploration.visibility import clear_beam, clear_lengths
from agents.slam.keyframes import Keyframes, Paths
from agents.slam.se2 import euclidean_distances, wrap_angle
from cyclic_env.jit import compiled


@dataclass(frozen=True, slots=True, kw_only=True)
class PlannerConfig(ComponentConfig):
    """Settings of the choice of the goal, of the patience with it, and of steering; lengths in metres."""

    turn_cost: float = 1.5
    """Metres of path that a radian of turning costs, so that the robot prefers to go on rather than back."""
    doubtful_cost: float = 6.0
    """Additional cost of a doubtful opening, since most of these turn out to be walls in passing."""
    unconfirmed_cost: float = 60.0
    """Additional cost of an unconfirmed opening, so that all others within a loop's length come first."""
    off_map_cost: float = 3.0
    """Additional cost of a goal off the costmap."""
    switch_share: float = 0.4
    switch_gain: float = 2.0
    """Another goal replaces the present one only if it costs less than this share of it, plus this many metres, so that
    the robot does not dither."""
    same_point: float = 0.3
    """Distance within which an open point is identified with the present goal."""
    same_goal: float = 0.5
    """Distance within which a new goal counts as the old one, so that the time without progress runs on."""
    progress: float = 0.5
    """Decrease of the cost, metres, that counts as progress."""
    patience: float = 9.0
    """Seconds without progress after which a goal is given up."""
    hesitation: float = 4.0
    """Seconds without progress after which the robot may turn off its path by any angle."""
    map_reach: float = 12.0
    """Distance from the robot within which keyframes' scans are drawn on the costmap."""
    map_scans: int = 20
    """Greatest number of scans on the costmap."""
    arrival: float = 0.8
    """Distance from a goal at which the robot looks around."""
    half_width: float = 0.31
    """Half of the width that the robot needs: its radius and a margin."""
    lookahead: float = 3.0
    """Greatest length of path that the robot cuts short; more would cut the corners that the path goes around."""
    passed: float = 0.6
    """Distance from a point of its path at which the robot heads for the next point."""
    target_clearance: float = 0.3
    """How far beyond the clear part of a beam a point of the path may lie."""
    avoidance: float = math.radians(60)
    """Greatest angle by which the robot turns off its path to avoid an obstacle."""
    clear_ahead: float = 1.0
    clear_ahead_min: float = 0.5
    """Length that must be clear where the robot drives; and the length that suffices if no bearing has the first."""
    turn_gain: float = 1.6
    turn_max: float = 0.8
    """Share of `turn_max` for each radian off the path, up to 1; and the greatest share of the full turning rate."""
    turn_on_spot: float = 1.2
    """Bearing of the path beyond which the robot turns on the spot."""
    slow_from: float = 0.8
    stop_at: float = 0.3
    slow_min: float = 0.15
    """The robot slows down over `slow_from` metres until it is `stop_at` metres from an obstacle ahead, to no less than
    the share `slow_min` of full speed."""


class Planner:
    """Holds the present goal, the path to it, and the patience with it.

    Parameters
    ----------
    beams : int
    dt : float
        Length of a step, seconds.
    costmap : Costmap
    config : PlannerConfig, optional

    Attributes
    ----------
    goal : (2,) float64 or None
        The goal in the frame of the track.
    path : (m, 2) float64
        The remaining points of the path to the goal.
    """

    def __init__(self, beams: int, dt: float, costmap: Costmap, config: PlannerConfig | None = None) -> None:
        self.config = config or PlannerConfig()
        self.goal: np.ndarray | None = None
        self.path = np.zeros((0, 2))
        self._kind_cost = np.array([0.0, self.config.doubtful_cost, 0.0, self.config.unconfirmed_cost])
        self._patience, self._hesitation = round(self.config.patience / dt), round(self.config.hesitation / dt)
        self._costmap = costmap
        self._clear = np.zeros(beams)
        self._on_map = False
        self._best_cost = math.inf  # of the goal, at the last progress
        self._steps_stuck = 0

    def squeeze(self, config: PlannerConfig, costmap: Costmap) -> None:
        """Use other settings and another costmap from now on; the patience stays."""
        self.config, self._costmap = config, costmap

    def select_goal(
        self,
        pose: np.ndarray,
        scan: np.ndarray,
        keyframes: Keyframes,
        goals: Frontiers | Survey,
        paths: Paths,
        order: np.ndarray | None = None,
    ) -> None:
        """Choose a point to go to: the present goal, or the cheapest point if the goal is gone or costs far more.

        Parameters
        ----------
        pose : (3,)
        scan : (beams,)
        keyframes : Keyframes
        goals : Frontiers or Survey
            The points to choose from.
        paths : Paths
            The paths from the last keyframe.
        order : (m,), optional
            Only points with the least value may be chosen; inf excludes a point.
        """
        points = goals.points(keyframes)
        if not len(points) or (order is not None and not np.isfinite(order).any()):
            self.goal = None
            return
        self._draw(pose, scan, keyframes, paths.distances)
        costs, ends, on_map = self._costs(pose, points, keyframes, goals, paths.distances)
        if order is not None:
            costs += np.where(order == order.min(), 0.0, np.inf)
        best = self._keep_or_switch(points, costs)
        kept = self.goal is not None and euclidean_distances(points[best : best + 1], self.goal)[0] < (
            self.config.same_goal
        )
        if not kept or costs[best] < self._best_cost - self.config.progress:
            self._best_cost, self._steps_stuck = float(costs[best]), 0
        goal = self.goal = points[best]
        if kept and self._on_map and not on_map[best] and len(self.path):
            return  # keep the path, although its end is off the map now
        self._on_map = bool(on_map[best])
        if self._on_map:
            self.path = self._costmap.path_to(int(ends[best]))
        else:
            on_route = paths.route(int(goals.keyframe[best]))
            self.path = self._path_along(np.vstack([keyframes.pose[on_route, :2], goal]))

    def _costs(
        self,
        pose: np.ndarray,
        points: np.ndarray,
        keyframes: Keyframes,
        goals: Frontiers | Survey,
        geodesic_m: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the cost of going to each point, the end of its path, and whether that is on the costmap."""
        euclidean_m = euclidean_distances(points, pose)
        costs, ends = self._costmap.costs_to(points)
        around = geodesic_m[goals.keyframe]
        on_map = np.isfinite(costs) & keyframes.is_direct(around, euclidean_m, self.config.map_reach)
        costs = np.where(on_map, costs, around + goals.polar[:, 0] + self.config.off_map_cost)
        bearings = np.arctan2(points[:, 1] - pose[1], points[:, 0] - pose[0]) - pose[2]
        turning = self.config.turn_cost * np.abs(wrap_angle(bearings))
        costs += turning + self._kind_cost[goals.polar[:, 2].astype(np.int64)]
        return costs, ends, on_map

    def _keep_or_switch(self, points: np.ndarray, costs: np.ndarray) -> int:
        """Return the index of the point to go to: that of the present goal, unless another costs far less."""
        best = int(np.argmin(costs))
        if self.goal is None:
            return best
        from_goal = euclidean_distances(points, self.goal)
        mine = int(np.argmin(from_goal))
        if from_goal[mine] >= self.config.same_point or not np.isfinite(costs[mine]):
            return best
        dearer = costs[best] >= self.config.switch_share * costs[mine] - self.config.switch_gain
        return mine if dearer else best

    def _path_along(self, spots: np.ndarray) -> np.ndarray:
        """Return the path `(m, 2)` along positions of keyframes `(n, 2)`, over the costmap as far as it extends."""
        driven = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(spots, axis=0).T))])
        costs, ends = self._costmap.costs_to(spots)
        on_map = np.flatnonzero((driven < self.config.map_reach) & np.isfinite(costs))
        if not len(on_map):
            return spots
        return np.vstack([self._costmap.path_to(int(ends[on_map[-1]])), spots[on_map[-1] + 1 :]])

    def _draw(self, pose: np.ndarray, scan: np.ndarray, keyframes: Keyframes, geodesic_m: np.ndarray) -> None:
        """Draw the costmap from the present scan and from every second one of the nearest keyframes' scans."""
        config = self.config
        euclidean_m = euclidean_distances(keyframes.pose, pose)
        near = np.flatnonzero((euclidean_m < config.map_reach) & keyframes.is_direct(geodesic_m, euclidean_m))
        spots = np.vstack([keyframes.pose[:, :2], pose[:2]])
        legs = np.stack([spots[near], spots[near + 1]], axis=1)
        near = near[np.argsort(euclidean_m[near], kind="stable")][: 2 * config.map_scans : 2]
        scans, poses = np.vstack([scan, keyframes.scan[near]]), np.vstack([pose, keyframes.pose[near]])
        self._costmap.draw(pose, scans, poses, legs)

    def has_arrived(self, pose: np.ndarray) -> bool:
        """Tell whether the robot is at its goal."""
        if self.goal is None:
            return False
        return math.hypot(pose[0] - self.goal[0], pose[1] - self.goal[1]) < self.config.arrival

    @property
    def gives_up(self) -> bool:
        """Whether the goal seems out of reach."""
        return self.goal is not None and self._steps_stuck > self._patience

    def clear_goal(self) -> None:
        """Forget the goal."""
        self.goal, self._best_cost, self._steps_stuck = None, math.inf, 0

    def steer(self, pose: np.ndarray, scan: np.ndarray) -> tuple[float, float]:
        """Return speed and turning rate along the path, as shares of the greatest ones."""
        if self.goal is None:
            return 0.0, 0.0
        self._steps_stuck += 1
        clear_lengths(scan, self.config.half_width, self._clear)
        reach = self.config.lookahead, self.config.target_clearance, self.config.passed
        target, bearing, distance = look_ahead(self.path, pose, self._clear, *reach)
        self.path = self.path[target:]
        avoidance = self.config.avoidance if self._steps_stuck < self._hesitation else math.pi
        return steer_to(self._clear, bearing, distance, avoidance, self.config)


@compiled
def look_ahead(path, pose, clear, lookahead, clearance, passed):
    """Return the farthest point of a path `(m, 2)` to which the way is clear, its bearing and its distance.

    Points that the robot has reached are skipped. If the way to no point is clear, the first point is taken.
    """
    spacing = 2 * math.pi / clear.shape[0]
    target = 0
    for k in range(path.shape[0]):
        dx, dy = path[k, 0] - pose[0], path[k, 1] - pose[1]
        distance = math.sqrt(dx * dx + dy * dy)
        beam = round((math.atan2(dy, dx) - pose[2]) / spacing) % clear.shape[0]
        if distance < lookahead and distance < clear[beam] + clearance:
            target = k
    dx, dy = path[target, 0] - pose[0], path[target, 1] - pose[1]
    if dx * dx + dy * dy < passed**2 and target < path.shape[0] - 1:
        target += 1
        dx, dy = path[target, 0] - pose[0], path[target, 1] - pose[1]
    bearing = math.atan2(dy, dx) - pose[2]
    bearing -= 2 * math.pi * math.floor((bearing + math.pi) / (2 * math.pi))
    return target, bearing, math.sqrt(dx * dx + dy * dy)


def steer_to(
    clear: np.ndarray, bearing: float, distance: float, avoidance: float, config: PlannerConfig
) -> tuple[float, float]:
    """Return speed and turning rate, as shares of the greatest ones, towards a point that may be behind an obstacle.

    Parameters
    ----------
    clear : (beams,)
        Clear length along each beam, metres, as `clear_lengths` writes it.
    bearing, distance : float
        Bearing and distance of the point, radians and metres.
    avoidance : float
        Greatest angle by which to turn aside for an obstacle, radians.
    config : PlannerConfig
    """
    for need in (min(config.clear_ahead, distance), config.clear_ahead_min):
        free = clear_beam(clear, bearing, need)
        if abs(wrap_angle(free - bearing)) <= avoidance:  # otherwise, as between door posts, follow the path
            bearing = wrap_angle(free)
            break
    turn = max(-1.0, min(1.0, config.turn_gain * bearing))
    # Turn on the spot when the path leads aside or back, and slow down for an obstacle ahead.
    speed = math.cos(bearing) ** 4 if abs(bearing) < config.turn_on_spot else 0.0
    slowed = min(1.0, max(config.slow_min, (clear[0] - config.stop_at) / config.slow_from))
    return speed * slowed, config.turn_max * turn
