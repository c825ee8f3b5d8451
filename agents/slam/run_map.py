"""What a robot has seen along its way: keyframes with panoramas, and the edges between them."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from agents.slam.keyframes import CAPACITY, KeyframeTable
from agents.slam.panorama import SIGNATURE_SECTORS
from agents.slam.pose_graph import PoseGraphConfig
from agents.slam.registration import Registration
from agents.slam.robust_graph import optimize_robustly
from agents.slam.scan_matching import Reference

NEIGHBORS = 16
"""Keyframes that one can be connected to at most; more would add no new ways."""
POSITION_STD, HEADING_STD = 0.01, np.radians(0.1)
"""What a match may err by beyond what the noise of its endpoints tells."""


class LoopEdge(NamedTuple):
    """A match of two keyframes across a loop: the later one's pose in the frame of the earlier one."""

    earlier: int
    later: int
    measured: np.ndarray
    information: np.ndarray
    closure: int
    """The number of the closure that found it: its edges are right or wrong together."""


class RunMap(KeyframeTable):
    """The keyframes of a run, and the pose graph over them.

    Parameters
    ----------
    beams : int
        Of a panorama.
    slots : int
        Edges of a keyframe to earlier ones. The last slot is for known ground, the others for those just before.

    Attributes
    ----------
    pose : (n, 3) float64
    scan, panorama : (n, beams) float64
        0 where not looked at.
    points, lines : (n, beams, 3) float64
        The panorama's endpoints and wall lines; see `Reference`.
    signature : (n, SIGNATURE_SECTORS) float64
    path : (n,) float64
        Metres driven.
    step : (n,) int64
        At which the keyframe was taken.
    heading : (n,) float64
        What the compass read.
    known : (n,) bool
        Whether it lies on known ground, and is tied to it.
    sources, measured, information : (n, slots), (n, slots, 3) and (n, slots, 3, 3)
        Edges: the earlier keyframe or -1, the pose in its frame, and the inverse covariance.
    closure : (n,) int64
        The last loop closure when the keyframe was tied to known ground; -1 for none.
    """

    scan: np.ndarray
    panorama: np.ndarray
    points: np.ndarray
    lines: np.ndarray
    signature: np.ndarray
    path: np.ndarray
    heading: np.ndarray
    known: np.ndarray
    sources: np.ndarray
    measured: np.ndarray
    information: np.ndarray
    closure: np.ndarray

    def __init__(self, beams: int, slots: int) -> None:
        self.closures = 0
        self.loops: list[LoopEdge] = []
        shapes: dict[str, tuple[type, tuple[int, ...]]] = {
            "pose": (np.float64, (3,)),
            "scan": (np.float64, (beams,)),
            "panorama": (np.float64, (beams,)),
            "points": (np.float64, (beams, 3)),
            "lines": (np.float64, (beams, 3)),
            "signature": (np.float64, (SIGNATURE_SECTORS,)),
            "path": (np.float64, ()),
            "step": (np.int64, ()),
            "heading": (np.float64, ()),
            "known": (np.bool_, ()),
            "sources": (np.int64, (slots,)),
            "measured": (np.float64, (slots, 3)),
            "information": (np.float64, (slots, 3, 3)),
            "closure": (np.int64, ()),
        }
        columns = {name: np.zeros((CAPACITY, *shape), kind) for name, (kind, shape) in shapes.items()}
        super().__init__(columns, NEIGHBORS)

    def add(self, **values: Any) -> int:
        """Add a keyframe without edges, connected to the last one; return its number."""
        number = super().add(**values)
        self.sources[-1] = self.closure[-1] = -1
        return number

    def reference(self, i: int) -> Reference:
        """Return keyframe i's panorama as others are matched with it."""
        return Reference(self.panorama[i], self.points[i], self.lines[i])

    def set_edge(self, i: int, slot: int, source: int, found: Registration) -> None:
        """Tie keyframe i to an earlier one as a match has it."""
        self.sources[i, slot], self.measured[i, slot] = source, found.pose
        self.information[i, slot] = with_floor(found.information)

    def add_loop(self, earlier: int, later: int, found: Registration) -> None:
        """Add a match across a loop, of the closure that is being made."""
        self.loops.append(LoopEdge(earlier, later, found.pose, with_floor(found.information), self.closures))
        self.connect(earlier, later)

    def optimize(self, heading_information: float, threshold: float, config: PoseGraphConfig) -> None:
        """Fit all poses to all edges and, with that inverse variance, to the compass.

        The edges of a closure that doesn't fit the others are left out.
        """
        edges, measured, information, doubtful = self.edges()
        # The first pose has the heading that the compass read there, with its error: the others tell that.
        error = np.exp(1j * (self.heading - self.pose[:, 2])).mean()
        headings, weights = self.heading - np.angle(error), np.full(self.count, heading_information)
        self.pose[:], _ = optimize_robustly(
            self.pose, edges, measured, information, doubtful, headings, weights, threshold, config
        )

    def edges(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return the edges `(m, 2)`, what was measured `(m, 3)`, its information `(m, 3, 3)`, and the closures `(m,)`.

        These number the loop closures that an edge rests on; -1 for none.
        """
        rows, slots = np.nonzero(self.sources >= 0)
        edges = np.column_stack([self.sources[rows, slots], rows])
        measured, information = self.measured[rows, slots], self.information[rows, slots]
        doubtful = np.where(slots == self.sources.shape[1] - 1, self.closure[rows], -1)
        if self.loops:
            edges = np.concatenate([edges, [(loop.earlier, loop.later) for loop in self.loops]])
            measured = np.concatenate([measured, [loop.measured for loop in self.loops]])
            information = np.concatenate([information, [loop.information for loop in self.loops]])
            doubtful = np.concatenate([doubtful, [loop.closure for loop in self.loops]])
        return edges, measured, information, doubtful


def with_floor(information: np.ndarray) -> np.ndarray:
    """Return the information of a match `(3, 3)`, less what `POSITION_STD` and `HEADING_STD` put in doubt."""
    covariance = np.linalg.inv(information + 1e-3 * np.eye(3))
    return np.linalg.inv(covariance + np.diag([POSITION_STD**2, POSITION_STD**2, HEADING_STD**2]))
