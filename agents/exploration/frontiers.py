"""The open areas' list: where scans have seen openings that no scan has seen into."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from agents.exploration.visibility import (
    BESIDE,
    DOUBTFUL,
    NEAR_SIGHT,
    UNBOUNDED,
    UNCONFIRMED,
    inside,
    is_explored,
    open_points,
    seen_through,
    to_track,
)
from agents.slam.keyframes import Keyframes
from agents.slam.se2 import euclidean_distances

DETOUR = 14.0
"""Metres by which the way to a place may be longer than the straight line if what one sees, the other sees too.

A cycle is longer than 40 m, so across one that has not been closed yet, the way is longer: what is seen beyond it stays
open until it has been driven round.
"""
SIGHT = 14.0
"""Metres between two places whose scans may overlap at points of one of them: a little more than the laser's reach."""
WITNESSES = 3
"""Scans as measured, of five, that see through to a point of an opening; with fewer, it comes last."""
ONWARD = 2.0
"""Metres that the robot goes on at a time from an opening that it comes to from the other side."""
MOST_POINTS = 400
"""Of one scan, or two a beam where that is more; others are left out."""
SAME_AREA = 2.0
"""Metres between points of one area at most: less than between two doors."""
LEFT_BEHIND = 6.0
"""Metres that the robot has gone away from an area again, by which it is one to come back to, and gets a number."""
BLACKLIST_RADIUS = 1.0
"""Metres around a point that can't be reached in which nothing is open any more."""


@dataclass(slots=True)
class OpenArea:
    """An area that was left behind open: one on the paper's list."""

    number: int
    keyframe: int
    """From which it was seen last."""
    offset: np.ndarray
    """Of its middle from that place, `(2,)`, metres east and north."""
    state: str = "open"
    """Or "visited", "struck off" (seen into from elsewhere), "out of reach"."""


class Frontiers:
    """Points on open edges, each seen from a place, and the areas that they are of.

    Attributes
    ----------
    polar : (m, 3) float64
        Range, beam and kind, as from `open_points`, at the place.
    keyframe : (m,) int64
    area : (m,) int64
        Alike for points of one area; counts up in the order in which areas are found.
    listed : list of OpenArea
    """

    def __init__(self, beams: int, range_max: float) -> None:
        self.beams = beams
        self.range_max = range_max
        self.polar = np.zeros((0, 3))
        self.keyframe = np.zeros(0, np.int64)
        self.area = np.zeros(0, np.int64)
        self.listed: list[OpenArea] = []
        self._numbers: dict[int, int] = {}  # area -> index into the list
        self._nearest: dict[int, float] = {}  # area -> metres from the robot when it was nearest
        self._areas = 0
        self._new = 0  # points at the end that have not been verified yet
        self._blacklist = np.zeros((0, 2))

    def __len__(self) -> int:
        return len(self.keyframe)

    def points(self, keyframes: Keyframes) -> np.ndarray:
        """Return the points `(m, 2)` in the frame of the track."""
        return to_track(self.polar, keyframes.pose[self.keyframe], 2 * np.pi / self.beams)

    @property
    def unbounded(self) -> np.ndarray:
        """Which points `(m,)` were seen with no wall within the laser's reach behind them."""
        return self.polar[:, 2] == UNBOUNDED

    def update(self, keyframes: Keyframes, geodesic_m: np.ndarray) -> None:
        """Strike off what the last place has settled, and add what it has opened.

        Parameters
        ----------
        keyframes : Keyframes
        geodesic_m : (n,)
            Of the ways from the last place, metres.
        """
        last = keyframes.count - 1
        pose = keyframes.pose[last]
        here = euclidean_distances(keyframes.pose, pose)
        if len(self):
            points = self.points(keyframes)
            euclidean_m = euclidean_distances(points, pose)
            near = geodesic_m[self.keyframe] <= euclidean_m + DETOUR
            arrived = self._sees(keyframes, last, points) & (euclidean_m < BESIDE)
            # Where the loop to a point is not closed yet, the robot goes on to where it was seen from, and closes it.
            ahead = arrived & ~near & (self.polar[:, 0] > ONWARD)
            self.polar[ahead, 0] -= ONWARD
            arrived &= ~ahead
            self._drop(near & self._is_explored(keyframes, np.array([last]), points) | arrived, arrived)
        if len(self):
            # A point is best kept by the place that sees it from nearest: the way to it leads from there.
            points = self.points(keyframes)
            euclidean_m = euclidean_distances(points, pose)
            nearer = self._sees(keyframes, last, points) & (euclidean_m < self.polar[:, 0])
            nearer &= geodesic_m[self.keyframe] <= euclidean_m + DETOUR
            self.keyframe[nearer] = last
            self.polar[nearer, 0] = euclidean_m[nearer]
            bearings = np.arctan2(*(points[nearer] - pose[:2]).T[::-1]) - pose[2]
            self.polar[nearer, 1] = bearings / (2 * np.pi / self.beams)
        self._add(keyframes, last, np.flatnonzero((here < SIGHT) & (geodesic_m <= here + DETOUR)))
        self._list(keyframes, pose)

    def _add(self, keyframes: Keyframes, last: int, near: np.ndarray) -> None:
        polar = np.empty((max(MOST_POINTS, 2 * self.beams), 3))
        polar = polar[: open_points(keyframes.scan[last], self.range_max, polar)]
        points = to_track(polar, np.tile(keyframes.pose[last], (len(polar), 1)), 2 * np.pi / self.beams)
        new = ~self._is_explored(keyframes, near[near != last], points)
        for blocked in self._blacklist:
            new &= euclidean_distances(points, blocked) >= BLACKLIST_RADIUS
        known, areas = self.points(keyframes), self.area.tolist()
        for polar_point, point in zip(polar[new], points[new], strict=True):
            euclidean_m = euclidean_distances(known, point)
            if len(euclidean_m) and euclidean_m.min() < SAME_AREA:
                areas.append(areas[int(np.argmin(euclidean_m))])
            else:
                areas.append(self._areas)
                self._areas += 1
            known = np.vstack([known, point])
            self.polar = np.vstack([self.polar, polar_point])
        self.area = np.array(areas, np.int64)
        self.keyframe = np.append(self.keyframe, np.full(int(new.sum()), last))
        self._new = int(new.sum())

    def verify(self, keyframes: Keyframes, measured: np.ndarray, poses: np.ndarray) -> None:
        """Put off what the last `update` has opened, unless `WITNESSES` scans see through to it: ranges may be wrong.

        Parameters
        ----------
        keyframes : Keyframes
        measured, poses : (m, beams) and (m, 3)
            Scans as measured, from shortly before and after that of the last place.
        """
        points = self.points(keyframes)
        witnesses = np.full(len(points), WITNESSES)
        new = slice(len(points) - self._new, None)
        seen_through(measured, poses, self.range_max, points[new], witnesses[new])
        self._new = 0
        self.polar[witnesses < WITNESSES, 2] = UNCONFIRMED

    def recheck(self, keyframes: Keyframes) -> None:
        """Strike off what places have seen that a closed loop has brought near."""
        points = self.points(keyframes)
        explored = np.zeros(len(points), np.bool_)
        for keyframe in np.unique(self.keyframe):
            mine = np.flatnonzero(self.keyframe == keyframe)
            geodesic_m, _ = keyframes.geodesic_distances(int(keyframe))
            euclidean_m = euclidean_distances(keyframes.pose, keyframes.pose[keyframe])
            euclidean_m[keyframe] = np.inf
            near = np.flatnonzero((euclidean_m < 2 * SIGHT) & (geodesic_m <= euclidean_m + DETOUR))
            explored[mine] = self._is_explored(keyframes, near, points[mine])
        self._drop(explored, np.zeros(len(points), np.bool_))

    def blacklist(self, keyframes: Keyframes, point: np.ndarray) -> None:
        """Strike off a point `(2,)` that can't be reached, and what is around it, for good."""
        around = euclidean_distances(self.points(keyframes), point) < BLACKLIST_RADIUS
        for area in np.unique(self.area[around]):
            if area in self._numbers and not (self.area[~around] == area).any():
                self.listed[self._numbers[area]].state = "out of reach"
        self._drop(around, around)
        self._blacklist = np.vstack([self._blacklist, point])

    def _is_explored(self, keyframes: Keyframes, seers: np.ndarray, points: np.ndarray) -> np.ndarray:
        explored = np.empty(len(points), np.bool_)
        is_explored(keyframes.scan[seers], keyframes.pose[seers], self.range_max, points, explored)
        return explored

    def _sees(self, keyframes: Keyframes, keyframe: int, points: np.ndarray) -> np.ndarray:
        seen = np.empty(len(points), np.bool_)
        inside(keyframes.scan[keyframe], *keyframes.pose[keyframe], points, -NEAR_SIGHT, seen)
        return seen

    def _drop(self, dropped: np.ndarray, arrived: np.ndarray) -> None:
        before = {area: bool(arrived[self.area == area].any()) for area in np.unique(self.area[dropped])}
        self._new -= int(dropped[len(dropped) - self._new :].sum())
        self.polar, self.keyframe, self.area = self.polar[~dropped], self.keyframe[~dropped], self.area[~dropped]
        for area, visited in before.items():
            listed = self._numbers.get(area)
            if listed is not None and self.listed[listed].state == "open" and not (self.area == area).any():
                self.listed[listed].state = "visited" if visited else "struck off"

    def _list(self, keyframes: Keyframes, pose: np.ndarray) -> None:
        points = self.points(keyframes)
        euclidean_m = euclidean_distances(points, pose)
        for area in set(self.area[~np.isin(self.polar[:, 2], (DOUBTFUL, UNCONFIRMED))].tolist()) - set(self._numbers):
            mine = np.flatnonzero(self.area == area)
            now = float(euclidean_m[mine].min())
            least = self._nearest[area] = min(now, self._nearest.get(area, now))
            if now > least + LEFT_BEHIND:
                self._numbers[area] = len(self.listed)
                keyframe = int(self.keyframe[mine[0]])
                offset = points[mine].mean(axis=0) - keyframes.pose[keyframe, :2]
                self.listed.append(OpenArea(number=len(self.listed) + 1, keyframe=keyframe, offset=offset))
