"""The open areas' list: where scans have seen openings that no scan has seen into."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from agents.slam.keyframes import Keyframes
from agents.slam.scan_filters import (
    BESIDE,
    DOUBTFUL,
    NEAR_SIGHT,
    UNBOUNDED,
    UNCONFIRMED,
    inside,
    open_points,
    seen_through,
    settles,
    to_track,
)
from agents.slam.se2 import distances

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
BANNED = 1.0
"""Metres around a point that can't be reached in which nothing is open any more."""


@dataclass(slots=True)
class OpenArea:
    """An area that was left behind open: one on the paper's list."""

    number: int
    place: int
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
    place : (m,) int64
    area : (m,) int64
        Alike for points of one area; counts up in the order in which areas are found.
    listed : list of OpenArea
    """

    def __init__(self, beams: int, range_max: float) -> None:
        self.beams = beams
        self.range_max = range_max
        self.polar = np.zeros((0, 3))
        self.place = np.zeros(0, np.int64)
        self.area = np.zeros(0, np.int64)
        self.listed: list[OpenArea] = []
        self._numbers: dict[int, int] = {}  # area -> index into the list
        self._nearest: dict[int, float] = {}  # area -> metres from the robot when it was nearest
        self._areas = 0
        self._new = 0  # points at the end that have not been verified yet
        self._banned = np.zeros((0, 2))

    def __len__(self) -> int:
        return len(self.place)

    def points(self, places: Keyframes) -> np.ndarray:
        """Return the points `(m, 2)` in the frame of the track."""
        return to_track(self.polar, places.pose[self.place], 2 * np.pi / self.beams)

    @property
    def unbounded(self) -> np.ndarray:
        """Which points `(m,)` were seen with no wall within the laser's reach behind them."""
        return self.polar[:, 2] == UNBOUNDED

    def update(self, places: Keyframes, lengths: np.ndarray) -> None:
        """Strike off what the last place has settled, and add what it has opened.

        Parameters
        ----------
        places : Keyframes
        lengths : (n,)
            Of the ways from the last place, metres.
        """
        last = places.count - 1
        pose = places.pose[last]
        here = distances(places.pose, pose)
        if len(self):
            points = self.points(places)
            away = distances(points, pose)
            near = lengths[self.place] <= away + DETOUR
            arrived = self._sees(places, last, points) & (away < BESIDE)
            # Where the loop to a point is not closed yet, the robot goes on to where it was seen from, and closes it.
            ahead = arrived & ~near & (self.polar[:, 0] > ONWARD)
            self.polar[ahead, 0] -= ONWARD
            arrived &= ~ahead
            self._drop(near & self._settles(places, np.array([last]), points) | arrived, arrived)
        if len(self):
            # A point is best kept by the place that sees it from nearest: the way to it leads from there.
            points = self.points(places)
            away = distances(points, pose)
            nearer = self._sees(places, last, points) & (away < self.polar[:, 0])
            nearer &= lengths[self.place] <= away + DETOUR
            self.place[nearer] = last
            self.polar[nearer, 0] = away[nearer]
            bearings = np.arctan2(*(points[nearer] - pose[:2]).T[::-1]) - pose[2]
            self.polar[nearer, 1] = bearings / (2 * np.pi / self.beams)
        self._add(places, last, np.flatnonzero((here < SIGHT) & (lengths <= here + DETOUR)))
        self._list(places, pose)

    def _add(self, places: Keyframes, last: int, near: np.ndarray) -> None:
        polar = np.empty((max(MOST_POINTS, 2 * self.beams), 3))
        polar = polar[: open_points(places.scan[last], self.range_max, polar)]
        points = to_track(polar, np.tile(places.pose[last], (len(polar), 1)), 2 * np.pi / self.beams)
        new = ~self._settles(places, near[near != last], points)
        for banned in self._banned:
            new &= distances(points, banned) >= BANNED
        known, areas = self.points(places), self.area.tolist()
        for polar_point, point in zip(polar[new], points[new], strict=True):
            away = distances(known, point)
            if len(away) and away.min() < SAME_AREA:
                areas.append(areas[int(np.argmin(away))])
            else:
                areas.append(self._areas)
                self._areas += 1
            known = np.vstack([known, point])
            self.polar = np.vstack([self.polar, polar_point])
        self.area = np.array(areas, np.int64)
        self.place = np.append(self.place, np.full(int(new.sum()), last))
        self._new = int(new.sum())

    def verify(self, places: Keyframes, measured: np.ndarray, poses: np.ndarray) -> None:
        """Put off what the last `update` has opened, unless `WITNESSES` scans see through to it: ranges may be wrong.

        Parameters
        ----------
        places : Keyframes
        measured, poses : (m, beams) and (m, 3)
            Scans as measured, from shortly before and after that of the last place.
        """
        points = self.points(places)
        witnesses = np.full(len(points), WITNESSES)
        new = slice(len(points) - self._new, None)
        seen_through(measured, poses, self.range_max, points[new], witnesses[new])
        self._new = 0
        self.polar[witnesses < WITNESSES, 2] = UNCONFIRMED

    def recheck(self, places: Keyframes) -> None:
        """Strike off what places have seen that a closed loop has brought near."""
        points = self.points(places)
        settled = np.zeros(len(points), np.bool_)
        for place in np.unique(self.place):
            mine = np.flatnonzero(self.place == place)
            lengths, _ = places.ways_from(int(place))
            away = distances(places.pose, places.pose[place])
            away[place] = np.inf
            near = np.flatnonzero((away < 2 * SIGHT) & (lengths <= away + DETOUR))
            settled[mine] = self._settles(places, near, points[mine])
        self._drop(settled, np.zeros(len(points), np.bool_))

    def ban(self, places: Keyframes, point: np.ndarray) -> None:
        """Strike off a point `(2,)` that can't be reached, and what is around it, for good."""
        around = distances(self.points(places), point) < BANNED
        for area in np.unique(self.area[around]):
            if area in self._numbers and not (self.area[~around] == area).any():
                self.listed[self._numbers[area]].state = "out of reach"
        self._drop(around, around)
        self._banned = np.vstack([self._banned, point])

    def _settles(self, places: Keyframes, seers: np.ndarray, points: np.ndarray) -> np.ndarray:
        settled = np.empty(len(points), np.bool_)
        settles(places.scan[seers], places.pose[seers], self.range_max, points, settled)
        return settled

    def _sees(self, places: Keyframes, place: int, points: np.ndarray) -> np.ndarray:
        seen = np.empty(len(points), np.bool_)
        inside(places.scan[place], *places.pose[place], points, -NEAR_SIGHT, seen)
        return seen

    def _drop(self, dropped: np.ndarray, arrived: np.ndarray) -> None:
        before = {area: bool(arrived[self.area == area].any()) for area in np.unique(self.area[dropped])}
        self._new -= int(dropped[len(dropped) - self._new :].sum())
        self.polar, self.place, self.area = self.polar[~dropped], self.place[~dropped], self.area[~dropped]
        for area, visited in before.items():
            listed = self._numbers.get(area)
            if listed is not None and self.listed[listed].state == "open" and not (self.area == area).any():
                self.listed[listed].state = "visited" if visited else "struck off"

    def _list(self, places: Keyframes, pose: np.ndarray) -> None:
        points = self.points(places)
        away = distances(points, pose)
        for area in set(self.area[~np.isin(self.polar[:, 2], (DOUBTFUL, UNCONFIRMED))].tolist()) - set(self._numbers):
            mine = np.flatnonzero(self.area == area)
            now = float(away[mine].min())
            least = self._nearest[area] = min(now, self._nearest.get(area, now))
            if now > least + LEFT_BEHIND:
                self._numbers[area] = len(self.listed)
                place = int(self.place[mine[0]])
                offset = points[mine].mean(axis=0) - places.pose[place, :2]
                self.listed.append(OpenArea(number=len(self.listed) + 1, place=place, offset=offset))
