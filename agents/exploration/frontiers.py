"""Frontiers: points where scans have seen openings that none has seen into; and the paper's list of open areas."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from agents.component_config import ComponentConfig, pack
from agents.exploration.visibility import (
    DOUBTFUL,
    UNBOUNDED,
    UNCONFIRMED,
    VisibilityConfig,
    VisibilityValues,
    inside,
    is_explored,
    open_points,
    seen_through,
    to_track,
)
from agents.slam.keyframes import Keyframes
from agents.slam.se2 import euclidean_distances


@dataclass(frozen=True, slots=True, kw_only=True)
class FrontierConfig(ComponentConfig):
    """Settings of which points stay open, and which open areas are listed; lengths in metres."""

    sight: float = 14.0
    """Greatest distance between keyframes of which one may see the other's open points; beyond the laser's reach."""
    witnesses: int = 3
    """Number of scans, of five, that must see through to an open point, or else the point comes last."""
    onward: float = 2.0
    """Distance that the robot drives on at a time from an opening that it has reached from the other side."""
    max_points: int = 400
    """Greatest number of open points of a scan, unless two per beam are more; others are left out."""
    same_area: float = 2.0
    """Greatest distance between neighbouring points of an area; less than between two doors."""
    left_behind: float = 6.0
    """Distance that the robot must have moved away from an area before it is listed as one to come back to."""
    blacklist_radius: float = 1.0
    """Distance within which all points around one that can't be reached are closed for good."""


@dataclass(slots=True)
class OpenArea:
    """An area that was left behind open: an entry in the paper's list."""

    number: int
    keyframe: int
    """The keyframe that sees it."""
    offset: np.ndarray
    """Offset of its centre from that keyframe, `(2,)`, metres east and north."""
    state: str = "open"
    """One of "open", "visited", "reached another way" (explored from elsewhere) and "out of reach"."""


@dataclass(slots=True)
class _Area:
    """An area of open points, listed or not."""

    nearest: float = np.inf
    """Least distance between the area and the robot so far, metres."""
    listed: OpenArea | None = None


@dataclass(slots=True)
class Frontiers:
    """Open points, each seen from a keyframe, and the areas that they belong to.

    Parameters
    ----------
    beams : int
    range_max : float
    config : FrontierConfig, optional
    visibility : VisibilityConfig, optional
    looks : (beams,) bool, optional
        Where the laser looks: only there it sees that something is open.

    Attributes
    ----------
    polar : (m, 3) float64
        Range, beam and kind of each point at its keyframe, as `open_points` writes them.
    keyframe : (m,) int64
    area : (m,) int64
        Equal for points of one area; areas are numbered as they are found.
    listed : list of OpenArea
    """

    beams: int
    range_max: float
    config: FrontierConfig = field(default_factory=FrontierConfig)
    visibility: VisibilityConfig = field(default_factory=VisibilityConfig)
    looks: np.ndarray | None = None
    polar: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)), init=False)
    keyframe: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64), init=False)
    area: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64), init=False)
    listed: list[OpenArea] = field(default_factory=list, init=False)
    _areas: list[_Area] = field(default_factory=list, init=False)
    _unverified: int = field(default=0, init=False)  # points at the end of the arrays
    _blacklist: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)), init=False)
    _values: Any = field(init=False)

    def __post_init__(self) -> None:
        self._values = pack(VisibilityValues, self.visibility)

    def __len__(self) -> int:
        return len(self.keyframe)

    def points(self, keyframes: Keyframes) -> np.ndarray:
        """Return the positions `(m, 2)` of the points in the frame of the track."""
        return to_track(self.polar, keyframes.pose[self.keyframe], 2 * np.pi / self.beams)

    @property
    def unbounded(self) -> np.ndarray:
        """Which points `(m,)` were seen with no wall within the laser's reach behind them."""
        return self.polar[:, 2] == UNBOUNDED

    def update(self, keyframes: Keyframes, geodesic_m: np.ndarray) -> None:
        """Resolve the points that the last keyframe has explored, and add those that it has opened.

        Parameters
        ----------
        keyframes : Keyframes
        geodesic_m : (n,)
            Lengths of the paths from the last keyframe to all keyframes, metres.
        """
        last = keyframes.count - 1
        pose = keyframes.pose[last]
        if len(self):
            points = self.points(keyframes)
            euclidean_m = euclidean_distances(points, pose)
            direct = keyframes.is_direct(geodesic_m[self.keyframe], euclidean_m)
            arrived = self._sees(keyframes, last, points) & (euclidean_m < self.visibility.beside)
            # If the loop to a point is not closed yet, the robot drives on to where it was seen from, to close it.
            ahead = arrived & ~direct & (self.polar[:, 0] > self.config.onward)
            self.polar[ahead, 0] -= self.config.onward
            arrived &= ~ahead
            self._resolve(direct & self._is_explored(keyframes, np.array([last]), points) | arrived, arrived)
        if len(self):
            # A point belongs to the nearest keyframe that sees it, from which the path to it leads.
            points = self.points(keyframes)
            euclidean_m = euclidean_distances(points, pose)
            nearer = self._sees(keyframes, last, points) & (euclidean_m < self.polar[:, 0])
            nearer &= keyframes.is_direct(geodesic_m[self.keyframe], euclidean_m)
            self.keyframe[nearer] = last
            self.polar[nearer, 0] = euclidean_m[nearer]
            bearings = np.arctan2(*(points[nearer] - pose[:2]).T[::-1]) - pose[2]
            self.polar[nearer, 1] = bearings / (2 * np.pi / self.beams)
        self._unverified = self._add(keyframes, last, geodesic_m)
        self._list(keyframes, pose)

    def _add(self, keyframes: Keyframes, keyframe: int, geodesic_m: np.ndarray) -> int:
        """Add the open points of a keyframe that those nearby have not explored; return how many."""
        here = euclidean_distances(keyframes.pose, keyframes.pose[keyframe])
        near = np.flatnonzero((here < self.config.sight) & keyframes.is_direct(geodesic_m, here))
        polar = np.empty((max(self.config.max_points, 2 * self.beams), 3))
        polar = polar[: open_points(keyframes.scan[keyframe], self.range_max, polar, self._values)]
        if self.looks is not None:
            polar = polar[self.looks[np.rint(polar[:, 1]).astype(np.int64) % self.beams]]
        points = to_track(polar, np.tile(keyframes.pose[keyframe], (len(polar), 1)), 2 * np.pi / self.beams)
        new = ~self._is_explored(keyframes, near[near != keyframe], points)
        for blocked in self._blacklist:
            new &= euclidean_distances(points, blocked) >= self.config.blacklist_radius
        known, areas = self.points(keyframes), self.area.tolist()
        for point in points[new]:
            euclidean_m = euclidean_distances(known, point)
            if len(euclidean_m) and euclidean_m.min() < self.config.same_area:
                areas.append(areas[int(np.argmin(euclidean_m))])
            else:
                areas.append(len(self._areas))
                self._areas.append(_Area())
            known = np.vstack([known, point])
        self.polar = np.vstack([self.polar, polar[new]])
        self.area = np.array(areas, np.int64)
        count = int(new.sum())
        self.keyframe = np.append(self.keyframe, np.full(count, keyframe))
        return count

    def reopen(self, keyframes: Keyframes, visibility: VisibilityConfig) -> None:
        """Forget which points could not be reached, and add all openings again that no scan has seen into.

        Parameters
        ----------
        keyframes : Keyframes
        visibility : VisibilityConfig
            The settings of what counts as open from now on.
        """
        self._values = pack(VisibilityValues, visibility)
        self._blacklist = self._blacklist[:0]
        for keyframe in range(keyframes.count):
            self._add(keyframes, keyframe, keyframes.geodesic_distances(keyframe).distances)
        self._unverified = 0

    def verify(self, keyframes: Keyframes, measured: np.ndarray, poses: np.ndarray) -> None:
        """Mark the points of the last `update` that too few scans see through to as unconfirmed: ranges may be wrong.

        Parameters
        ----------
        keyframes : Keyframes
        measured, poses : (m, beams) and (m, 3)
            Unfiltered scans, taken shortly before and after the last keyframe.
        """
        points = self.points(keyframes)
        witnesses = np.full(len(points), self.config.witnesses)
        new = slice(len(points) - self._unverified, None)
        seen_through(measured, poses, self.range_max, points[new], witnesses[new])
        self._unverified = 0
        self.polar[witnesses < self.config.witnesses, 2] = UNCONFIRMED

    def recheck(self, keyframes: Keyframes) -> None:
        """Resolve the points that have been explored by keyframes to which a closed loop is a shortcut."""
        points = self.points(keyframes)
        explored = np.zeros(len(points), np.bool_)
        for keyframe in np.unique(self.keyframe):
            mine = np.flatnonzero(self.keyframe == keyframe)
            geodesic_m = keyframes.geodesic_distances(int(keyframe)).distances
            euclidean_m = euclidean_distances(keyframes.pose, keyframes.pose[keyframe])
            euclidean_m[keyframe] = np.inf
            near = (euclidean_m < 2 * self.config.sight) & keyframes.is_direct(geodesic_m, euclidean_m)
            explored[mine] = self._is_explored(keyframes, np.flatnonzero(near), points[mine])
        self._resolve(explored, np.zeros(len(points), np.bool_))

    def blacklist(self, keyframes: Keyframes, point: np.ndarray) -> None:
        """Give up a point `(2,)` that can't be reached, and the points around it, until `reopen`."""
        around = euclidean_distances(self.points(keyframes), point) < self.config.blacklist_radius
        for area in np.unique(self.area[around]):
            listed = self._areas[area].listed
            if listed is not None and not (self.area[~around] == area).any():
                listed.state = "out of reach"
        self._resolve(around, around)
        self._blacklist = np.vstack([self._blacklist, point])

    def _is_explored(self, keyframes: Keyframes, seers: np.ndarray, points: np.ndarray) -> np.ndarray:
        explored = np.empty(len(points), np.bool_)
        is_explored(keyframes.scan[seers], keyframes.pose[seers], self.range_max, points, explored, self._values)
        return explored

    def _sees(self, keyframes: Keyframes, keyframe: int, points: np.ndarray) -> np.ndarray:
        seen = np.empty(len(points), np.bool_)
        inside(keyframes.scan[keyframe], keyframes.pose[keyframe], points, -self.visibility.near_sight, seen)
        return seen

    def _resolve(self, resolved: np.ndarray, arrived: np.ndarray) -> None:
        """Drop resolved points, and set the state of the listed areas without any points left."""
        before = {area: bool(arrived[self.area == area].any()) for area in np.unique(self.area[resolved])}
        self._unverified -= int(resolved[len(resolved) - self._unverified :].sum())
        self.polar, self.keyframe, self.area = self.polar[~resolved], self.keyframe[~resolved], self.area[~resolved]
        for area, visited in before.items():
            listed = self._areas[area].listed
            if listed is not None and listed.state == "open" and not (self.area == area).any():
                listed.state = "visited" if visited else "reached another way"

    def _list(self, keyframes: Keyframes, pose: np.ndarray) -> None:
        """List the areas that the robot has left behind."""
        points = self.points(keyframes)
        euclidean_m = euclidean_distances(points, pose)
        for number in np.unique(self.area[~np.isin(self.polar[:, 2], (DOUBTFUL, UNCONFIRMED))]).tolist():
            area = self._areas[number]
            if area.listed is not None:
                continue
            mine = np.flatnonzero(self.area == number)
            now = float(euclidean_m[mine].min())
            area.nearest = min(now, area.nearest)
            if now > area.nearest + self.config.left_behind:
                keyframe = int(self.keyframe[mine[0]])
                offset = points[mine].mean(axis=0) - keyframes.pose[keyframe, :2]
                area.listed = OpenArea(number=len(self.listed) + 1, keyframe=keyframe, offset=offset)
                self.listed.append(area.listed)
