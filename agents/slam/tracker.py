"""Where the robot is: by dead reckoning, or by a map that it makes on its way."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np

from agents.slam.keyframes import Keyframes
from agents.slam.mapper import Mapper, MapperConfig
from agents.slam.registration import Registration
from agents.slam.se2 import wrap_angle
from cyclic_env.config import LaserConfig


class PoseGraph(NamedTuple):
    """Poses `(n, 3)` and the relations between them that were measured."""

    poses: np.ndarray
    edges: list[tuple[int, int, np.ndarray, np.ndarray]]
    """(i, j, pose of j in the frame of i `(3,)`, information `(3, 3)`)."""


class PoseTracker(ABC):
    """The pose of the robot in a frame with its origin at the start and the axes of the compass.

    Attributes
    ----------
    odometry : (2,) float64
        The position by dead reckoning alone, from the compass and the distance meter.
    compass : float
        Its last reading as a heading.
    """

    def __init__(self) -> None:
        self.odometry = np.zeros(2)
        self.compass = 0.0
        self._distance: float | None = None

    def advance(self, distance: float, compass: np.ndarray) -> None:
        """Take a reading of the distance meter, metres, and of the compass `(2,)`, east and north."""
        heading = math.atan2(compass[1], compass[0])
        before, driven = self.compass, 0.0 if self._distance is None else distance - self._distance
        self._distance, self.compass = distance, heading
        # An arc's chord points midway between the headings at its ends.
        middle = before + 0.5 * wrap_angle(heading - before)
        self.odometry += driven * np.array([math.cos(middle), math.sin(middle)])
        self._move(distance, driven)

    @property
    @abstractmethod
    def pose(self) -> np.ndarray:
        """Of the robot now, `(3,)`."""

    @property
    @abstractmethod
    def path(self) -> float:
        """Metres driven, forward and backward."""

    @abstractmethod
    def _move(self, distance: float, driven: float) -> None:
        """Follow the readings that were taken."""

    @abstractmethod
    def follow(self, keyframes: Keyframes, ranges: np.ndarray) -> bool:
        """Take the laser's ranges `(num_beams,)` between two rows; return whether the track was corrected by them."""

    @abstractmethod
    def add_row(self, keyframes: Keyframes, ranges: np.ndarray) -> None:
        """Take the laser's ranges `(num_beams,)` where a row is about to be added, and correct the track by them."""

    @property
    @abstractmethod
    def panorama(self) -> np.ndarray | None:
        """The ranges all around at the last row, as the latest scans tell them; 0 where none has looked."""

    @abstractmethod
    def join(self, row: int) -> None:
        """Take it that the last row is near an earlier one."""

    @abstractmethod
    def graph(self, keyframes: Keyframes) -> PoseGraph:
        """Return the pose graph that the track comes from."""


class DeadReckoningTracker(PoseTracker):
    """The distance meter and the compass alone: nothing corrects the pose."""

    def __init__(self) -> None:
        super().__init__()
        self._path = 0.0

    @property
    def pose(self) -> np.ndarray:
        """As the readings tell it."""
        return np.array([*self.odometry, wrap_angle(self.compass)])

    @property
    def path(self) -> float:
        """As the readings tell it."""
        return self._path

    def _move(self, distance: float, driven: float) -> None:
        self._path += abs(driven)

    def follow(self, keyframes: Keyframes, ranges: np.ndarray) -> bool:
        """Do nothing."""
        return False

    def add_row(self, keyframes: Keyframes, ranges: np.ndarray) -> None:
        """Do nothing."""

    @property
    def panorama(self) -> np.ndarray | None:
        """None: nothing is put together."""
        return None

    def join(self, row: int) -> None:
        """Do nothing."""

    def graph(self, keyframes: Keyframes) -> PoseGraph:
        """Return the rows, without edges."""
        return PoseGraph(keyframes.pose, [])


class MappingTracker(PoseTracker):
    """The map's track, to whose keyframes the rows of the tables belong.

    Parameters
    ----------
    laser : LaserConfig
    config : MapperConfig, optional

    Attributes
    ----------
    mapper : Mapper
    rows : list of int
        For each row, the mapper's keyframe there.
    """

    def __init__(self, laser: LaserConfig, config: MapperConfig | None = None) -> None:
        super().__init__()
        self.mapper = Mapper(laser, config)
        self.rows: list[int] = []

    @property
    def pose(self) -> np.ndarray:
        """The mapper's."""
        return self.mapper.pose

    @property
    def path(self) -> float:
        """The mapper's."""
        return self.mapper.path

    def _move(self, distance: float, driven: float) -> None:
        self.mapper.advance(distance, self.compass)

    def follow(self, keyframes: Keyframes, ranges: np.ndarray) -> bool:
        """Take a keyframe where the map needs one."""
        if not self.mapper.is_due:
            return False
        self._add_keyframe(keyframes, ranges)
        return True

    def add_row(self, keyframes: Keyframes, ranges: np.ndarray) -> None:
        """Take a keyframe."""
        if not self.mapper.has_keyframe:
            self._add_keyframe(keyframes, ranges)
        self.rows.append(self.mapper.run.count - 1)

    def _add_keyframe(self, keyframes: Keyframes, ranges: np.ndarray) -> None:
        self.mapper.add_keyframe(ranges)
        keyframes.pose[:] = self.mapper.run.pose[self.rows]

    @property
    def panorama(self) -> np.ndarray | None:
        """The mapper's."""
        return self.mapper.run.panorama[-1]

    def join(self, row: int) -> None:
        """Let a way lead straight from one to the other."""
        self.mapper.run.connect(self.rows[row], self.rows[-1])

    def close_loop(self, keyframes: Keyframes, row: int, found: Registration) -> None:
        """Take it that the last row lies in an earlier one's frame as was found, and correct all rows."""
        self.mapper.close_loop(self.rows[row], found)
        keyframes.pose[:] = self.mapper.run.pose[self.rows]

    def row_at(self, keyframe: int) -> int:
        """Return the row that was taken last before one of the mapper's keyframes, or there."""
        return max(0, int(np.searchsorted(self.rows, keyframe, "right")) - 1)

    def graph(self, keyframes: Keyframes) -> PoseGraph:
        """Return the mapper's."""
        run = self.mapper.run
        edges, measured, information, _ = run.edges()
        return PoseGraph(
            run.pose, [(int(i), int(j), m, w) for (i, j), m, w in zip(edges, measured, information, strict=True)]
        )
