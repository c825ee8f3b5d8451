"""What loop closures do to a map: the error of a pose graph with them, plain and robust, and the price of a false one.

The graph joins successive poses by the odometry, and a claim's two poses by what it measured. Where a claim only says
that they are the same place, it joins their positions to within a metre.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from agents.slam.pose_graph import PoseGraphConfig, optimize
from agents.slam.robust_graph import optimize_robustly
from cyclic_env.errors import RecordingError
from cyclic_env.evaluation.claim_matching import TOLERANCE
from cyclic_env.trajectory.metrics import ate, match_times
from cyclic_env.trajectory.poses import relative
from cyclic_env.trajectory.readers import Trajectory

POSITION_DRIFT, HEADING_DRIFT = 0.05, math.radians(0.7)
"""Standard deviations of the odometry, metres and radians per square root of a metre driven."""
SPACING = 1.0
"""Metres between the poses of the graph, besides those of claims."""
STEP_MIN = 0.1
"""Metres that a step counts as, at least: turns on the spot err, too."""
SAME_PLACE_STD = 1.0
"""Metres by which two poses that a claim calls the same place may differ."""
MEASURED_STD = (0.1, 0.1, math.radians(1))
"""Of the relative pose of a claim that measured it."""
THRESHOLD = 11.3
"""Squared error, in standard deviations, up to which the robust graph keeps a claim: chi-squared of 3 at 99 %."""
PRICED_MAX = 10
"""False claims that are priced one by one, at most, evenly chosen."""
SOLVER = PoseGraphConfig(iterations=15)


@dataclass(frozen=True, slots=True, kw_only=True)
class ClosurePrice:
    """Map errors: ATE RMSE in metres after a rigid alignment.

    Attributes
    ----------
    odometry_m : float
        Without any claim.
    right_m, right_robust_m : float
        With all right claims, by the plain and the robust graph.
    all_m, all_robust_m : float
        With the false ones, too.
    rejected_right, rejected_false : int
        Claims that the robust graph left out of all.
    right, false : int
    each : tuple of (int, float, float)
        Of up to `PRICED_MAX` false claims: the step, and the errors, plain and robust, with this one besides all right
        ones.
    """

    odometry_m: float
    right_m: float
    right_robust_m: float
    all_m: float
    all_robust_m: float
    rejected_right: int
    rejected_false: int
    right: int
    false: int
    each: tuple[tuple[int, float, float], ...]


def price_run(
    reference: Trajectory,
    odometry: Trajectory,
    judged: np.ndarray,
    measured: np.ndarray | None = None,
    *,
    tolerance: float = TOLERANCE,
    on_step: Callable[[], Any] = lambda: None,
) -> ClosurePrice:
    """Return what the judged claims of a run do to its map.

    Parameters
    ----------
    reference, odometry : Trajectory
    judged : (m,) CLAIM
        By the reference's poses, as `JudgeReport.judged`.
    measured : (m, 3), optional
        The pose at each claim in the frame of the pose at its match.
    tolerance : float
        Seconds by which the time stamps of the same moment may differ.
    on_step : callable, optional
        Called after every graph.

    Raises
    ------
    RecordingError
        If the odometry has no pose at the moments of a claim.
    """
    at = match_times(reference.times, odometry.times, tolerance)
    pairs = np.column_stack([judged["step"], judged["match"]]).astype(np.int64)
    if (at[pairs] < 0).any() or not (at >= 0).any():
        raise RecordingError("the odometry has no pose at the moments of the claims; are both of the same clock?")
    steps = np.hypot(*np.diff(reference.poses[:, :2], axis=0).T)
    passed = np.floor(np.append(0.0, np.cumsum(steps)) / SPACING)
    kept = np.diff(passed, prepend=-1.0) > 0
    kept[pairs] = True
    kept &= at >= 0
    number = np.cumsum(kept) - 1
    return price_closures(
        odometry.poses[at[kept]], reference.poses[kept], number[pairs], judged["correct"], measured, on_step
    )


def price_closures(
    odometry: np.ndarray,
    reference: np.ndarray,
    pairs: np.ndarray,
    right: np.ndarray,
    measured: np.ndarray | None = None,
    on_step: Callable[[], Any] = lambda: None,
) -> ClosurePrice:
    """Return what claims do to the map.

    Parameters
    ----------
    odometry, reference : (n, 3)
        Poses at the same moments.
    pairs : (m, 2) int
        The poses that each claim joins, the later first.
    right : (m,) bool
    measured : (m, 3), optional
        The later pose in the frame of the earlier one.
    on_step : callable, optional
        Called after every graph.
    """
    graph = _Graph(odometry, reference, pairs, measured)
    everything, true = np.arange(len(pairs)), np.flatnonzero(right)
    false = np.flatnonzero(~right)

    def error(claims: np.ndarray, robust: bool) -> tuple[float, np.ndarray]:
        result = graph.solve(claims, robust)
        on_step()
        return result

    all_robust, weights = error(everything, True)
    rejected = weights < 0.5
    chosen = false[np.unique(np.linspace(0, len(false) - 1, min(len(false), PRICED_MAX)).astype(int))]
    each = []
    for k in chosen.tolist():
        with_it = np.append(true, k)
        each.append((int(pairs[k, 0]), error(with_it, False)[0], error(with_it, True)[0]))
    return ClosurePrice(
        odometry_m=error(everything[:0], False)[0],
        right_m=error(true, False)[0],
        right_robust_m=error(true, True)[0],
        all_m=error(everything, False)[0],
        all_robust_m=all_robust,
        rejected_right=int(np.count_nonzero(rejected & right)),
        rejected_false=int(np.count_nonzero(rejected & ~right)),
        right=len(true),
        false=len(false),
        each=tuple(each),
    )


class _Graph:
    """The pose graph of a run, into which any of its claims can be put."""

    def __init__(
        self, odometry: np.ndarray, reference: np.ndarray, pairs: np.ndarray, measured: np.ndarray | None
    ) -> None:
        n = len(odometry)
        self.odometry, self.reference = odometry, reference
        self.chain = np.column_stack([np.arange(n - 1), np.arange(1, n)])
        self.steps = relative(odometry[:-1], odometry[1:])
        driven = np.maximum(np.hypot(self.steps[:, 0], self.steps[:, 1]), STEP_MIN)
        self.chain_information = np.zeros((n - 1, 3, 3))
        for axis, drift in enumerate((POSITION_DRIFT, POSITION_DRIFT, HEADING_DRIFT)):
            self.chain_information[:, axis, axis] = 1 / (drift**2 * driven)
        self.pairs = pairs[:, ::-1]
        self.measured = np.zeros((len(pairs), 3)) if measured is None else measured
        std = np.array([SAME_PLACE_STD, SAME_PLACE_STD, np.inf] if measured is None else MEASURED_STD)
        self.information = np.repeat(np.diag(std**-2.0)[None], len(pairs), axis=0)

    def solve(self, claims: np.ndarray, robust: bool) -> tuple[float, np.ndarray]:
        """Return the map error with some of the claims, and the weights that they were given."""
        edges = np.concatenate([self.chain, self.pairs[claims]])
        measured = np.concatenate([self.steps, self.measured[claims]])
        information = np.concatenate([self.chain_information, self.information[claims]])
        none = np.zeros(len(self.odometry))
        weights = np.ones(len(edges))
        if robust:
            doubtful = np.concatenate([np.full(len(self.chain), -1), np.arange(len(claims))])
            poses, weights = optimize_robustly(
                self.odometry, edges, measured, information, doubtful, none, none, THRESHOLD, SOLVER
            )
        else:
            poses = optimize(self.odometry, edges, measured, information, none, none, SOLVER)
        return ate(poses[:, :2], self.reference[:, :2], align=True), weights[len(self.chain) :]
