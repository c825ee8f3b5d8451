"""A judge for anyone's run: a trajectory, its loop closures and a reference, from whatever SLAM system.

Claims are judged by the definitions of `cyclic_env.task.loop_closure`, and by those that others publish beside them.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from cyclic_env.config import ClosureConfig
from cyclic_env.evaluation.claim_matching import TOLERANCE, MatchedClaims, check_matched, match_claims
from cyclic_env.evaluation.precision_recall import PrecisionRecall, precision_recall
from cyclic_env.evaluation.scan_overlap import Scans, greatest_overlaps, overlaps_of
from cyclic_env.floor_plans import FloorPlan
from cyclic_env.task.loop_closure import NEAREST
from cyclic_env.task.trajectory_truth import closure_config_for, judge_trajectory
from cyclic_env.trajectory.metrics import RelationErrors, ate, match_times, relation_errors
from cyclic_env.trajectory.poses import relative
from cyclic_env.trajectory.readers import Claims, Relations, Trajectory

PUBLISHED_RADII = (3.0, 5.0)
"""Metres within which others count a return, whatever walls lie between."""

OVERLAPS = (0.3, 0.5)
"""Overlaps of two scans from which others count a return."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Verdict:
    """What the claims are worth under one definition of a return, claim spacing set aside.

    Attributes
    ----------
    definition : str
    rows : int
        Poses that return to an earlier one: all that could be recognised.
    right, wrong : int
        Claims; those that fail only by coming too soon are neither.
    curve : PrecisionRecall
        Over the scores of the claims; its recall is the share of the rows.
    """

    definition: str
    rows: int
    right: int
    wrong: int
    curve: PrecisionRecall

    @property
    def precision(self) -> float:
        """The share of right claims; 1 if there are none."""
        judged = self.right + self.wrong
        return self.right / judged if judged else 1.0

    @property
    def row_recall(self) -> float:
        """The share of the rows with a right claim; 1 if there are none."""
        return self.right / self.rows if self.rows else 1.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class JudgeReport:
    """All that the judge says of a run.

    Attributes
    ----------
    poses, rows : int
        Poses of the reference, and those among them that the estimate has, too.
    path_length_m : float
    claims_given, claims_unmatched, claims_repeated : int
        Claims in all, those without a pose of the reference at their time, and further ones at the same pose.
    claims, false_claims : int
        Judged ones, claim spacing kept.
    revisits, revisits_recognised : int
        Events.
    precision, recall : float
        Of events.
    cycles_closed, cycles_total : int or None
        None without a plan.
    closure : ClosureConfig
    verdicts : tuple of Verdict
        Under our definition first.
    ate_m, ate_aligned_m : float or None
        None without an estimate.
    relations : RelationErrors or None
        None without an estimate, or without relations.
    relations_are : str
        Which ones.
    judged : (claims,) CLAIM
        The judged claims, by the reference's poses.
    """

    poses: int
    rows: int
    path_length_m: float
    claims_given: int
    claims_unmatched: int
    claims_repeated: int
    claims: int
    false_claims: int
    revisits: int
    revisits_recognised: int
    precision: float
    recall: float
    cycles_closed: int | None
    cycles_total: int | None
    closure: ClosureConfig
    verdicts: tuple[Verdict, ...]
    ate_m: float | None
    ate_aligned_m: float | None
    relations: RelationErrors | None
    relations_are: str
    judged: np.ndarray

    def to_json(self) -> dict[str, Any]:
        """Return everything as plain numbers, strings, lists and dicts."""
        ours = self.verdicts[0]
        plain = {name: getattr(self, name) for name in self.__dataclass_fields__ if name not in ("verdicts", "judged")}
        plain["closure"] = asdict(self.closure)
        plain["relations"] = None if self.relations is None else self.relations._asdict()
        plain |= {"row_recall": ours.row_recall, "row_returns": ours.rows, "rows_right": ours.right}
        plain["definitions"] = [
            {
                "definition": verdict.definition,
                "rows": verdict.rows,
                "right": verdict.right,
                "wrong": verdict.wrong,
                "precision": verdict.precision,
                "row_recall": verdict.row_recall,
                **{
                    name: value.tolist() if isinstance(value, np.ndarray) else value
                    for name, value in zip(("thresholds", "precisions", "recalls"), verdict.curve[:3], strict=True)
                },
                **{name: getattr(verdict.curve, name) for name in PrecisionRecall._fields[3:]},
            }
            for verdict in self.verdicts
        ]
        return plain


def judge_run(
    reference: Trajectory,
    claims: Claims,
    *,
    estimate: Trajectory | None = None,
    plan: FloorPlan | None = None,
    closure: ClosureConfig | None = None,
    scans: Scans | None = None,
    relations: Relations | None = None,
    tolerance: float = TOLERANCE,
) -> JudgeReport:
    """Judge a run's loop closures and its trajectory.

    Parameters
    ----------
    reference : Trajectory
        The true poses, or the best known ones; in the plan's frame, if there is a plan. Claims are judged by them.
    claims : Claims
    estimate : Trajectory, optional
        What the SLAM system says, in any frame. Its poses that the reference has, too, are the rows of which recall is
        counted; by default all of the reference's are.
    plan : FloorPlan, optional
        The building. Without it nothing blocks the sight, and there are no cycles.
    closure : ClosureConfig, optional
        Default: `closure_config_for` the plan and the reference.
    scans : Scans, optional
        Scans at poses of the reference, for definitions by their overlap.
    relations : Relations, optional
        Known relative poses. Default: those of the reference, between each row that returns and the nearest earlier
        pose that it returns to.
    tolerance : float
        Seconds by which the time stamps of the same moment may differ.

    Raises
    ------
    RecordingError
        If the estimate, the claims, or the relations have no moment in common with the reference.
    UsageError
        If the reference doesn't lie on the plan.
    """
    closure = closure or closure_config_for(plan, reference.poses)
    matched = match_claims(claims, reference.times, tolerance)
    positions = reference.poses[:, :2]
    judged = judge_trajectory(plan, positions, matched.pairs, closure)
    rows, error, aligned = np.arange(len(positions)), None, None
    estimated = np.full(len(positions), -1)  # the estimate's pose at each of the reference's
    if estimate is not None:
        at = check_matched(match_times(estimate.times, reference.times, tolerance), "trajectory", tolerance)
        found = np.flatnonzero(at >= 0)
        estimated[at[found]] = found
        rows = np.unique(at[found])
        estimates = estimate.poses[estimated[rows], :2]
        error, aligned = ate(estimates, positions[rows]), ate(estimates, positions[rows], align=True)
    verdicts = [_verdict(plan, positions, matched, closure, rows, _our_name(plan, closure))]
    for radius in PUBLISHED_RADII:
        theirs = ClosureConfig(return_radius=radius, gap=closure.gap, leave_radius=2 * radius)
        verdicts.append(_verdict(None, positions, matched, theirs, rows, f"within {radius:g} m, whatever lies between"))
    if scans is not None:
        verdicts += _overlap_verdicts(reference, scans, matched, closure.gap, rows, tolerance)
    known, which = relations, "given"
    if known is None:
        known, which = _returns(plan, reference, closure, rows), "of returning rows to where they return"
    return JudgeReport(
        poses=len(positions),
        rows=len(rows),
        path_length_m=float(np.hypot(*np.diff(positions, axis=0).T).sum()),
        claims_given=len(claims.times),
        claims_unmatched=matched.unmatched,
        claims_repeated=matched.repeated,
        claims=len(judged.claims),
        false_claims=judged.false_claims,
        revisits=judged.revisits,
        revisits_recognised=judged.revisits_recognised,
        precision=judged.precision,
        recall=judged.recall,
        cycles_closed=None if plan is None else judged.cycles_closed,
        cycles_total=None if plan is None else judged.cycles_total,
        closure=closure,
        verdicts=tuple(verdicts),
        ate_m=error,
        ate_aligned_m=aligned,
        relations=None if estimate is None else _relation_errors(estimate, known, tolerance),
        relations_are=which,
        judged=judged.claims,
    )


def _our_name(plan: FloorPlan | None, closure: ClosureConfig) -> str:
    sight = "" if plan is None else ", in sight"
    return (
        f"within {closure.return_radius:g} m{sight}, {closure.gap:g} m driven, "
        f"{closure.leave_radius:g} m away in between (ours)"
    )


def _verdict(
    plan: FloorPlan | None,
    positions: np.ndarray,
    matched: MatchedClaims,
    closure: ClosureConfig,
    rows: np.ndarray,
    definition: str,
) -> Verdict:
    judged = judge_trajectory(plan, positions, matched.pairs, replace(closure, claim_spacing=0.0))
    counted = np.isin(judged.claims["step"], rows)
    right = judged.claims["correct"][counted]
    scores = None
    if matched.scores is not None:
        scores = matched.scores[np.searchsorted(matched.pairs[:, 0], judged.claims["step"][counted])]
    returning = int(np.count_nonzero(judged.revisit[rows]))
    return _of_claims(definition, returning, right, scores)


def _of_claims(definition: str, rows: int, right: np.ndarray, scores: np.ndarray | None) -> Verdict:
    hits = int(np.count_nonzero(right))
    return Verdict(
        definition=definition,
        rows=rows,
        right=hits,
        wrong=len(right) - hits,
        curve=precision_recall(right, scores, rows),
    )


def _overlap_verdicts(
    reference: Trajectory, scans: Scans, matched: MatchedClaims, gap: float, rows: np.ndarray, tolerance: float
) -> list[Verdict]:
    """Return verdicts by the overlap of scans, of the rows and claims that have scans."""
    at = check_matched(match_times(scans.times, reference.times, tolerance), "scans", tolerance)
    kept = np.flatnonzero(at >= 0)
    places, first = np.unique(at[kept], return_index=True)
    kept = kept[first]
    scans = replace(scans, times=scans.times[kept], ranges=scans.ranges[kept])
    poses = reference.poses[places]
    steps = np.hypot(*np.diff(reference.poses[:, :2], axis=0).T)
    path = np.append(0.0, np.cumsum(steps))[places]
    greatest = greatest_overlaps(scans, poses, path, gap, max(OVERLAPS))[np.isin(places, rows)]
    number = np.full(len(reference.times), -1)
    number[places] = np.arange(len(places))
    pairs = number[matched.pairs]
    judged = np.flatnonzero((pairs >= 0).all(axis=1) & np.isin(matched.pairs[:, 0], rows))
    judged = judged[path[pairs[judged, 0]] - path[pairs[judged, 1]] >= gap]
    overlaps = overlaps_of(scans, poses, pairs[judged])
    scores = None if matched.scores is None else matched.scores[judged]
    return [
        _of_claims(f"scans overlap by {least:.0%}", int(np.count_nonzero(greatest >= least)), overlaps >= least, scores)
        for least in OVERLAPS
    ]


def _returns(plan: FloorPlan | None, reference: Trajectory, closure: ClosureConfig, rows: np.ndarray) -> Relations:
    """Return the reference's relations of each of its rows that returns to the nearest pose that it returns to."""
    asked = np.column_stack([rows, np.full(len(rows), NEAREST)])[rows > 0]
    judged = judge_trajectory(plan, reference.poses[:, :2], asked, replace(closure, claim_spacing=0.0))
    pairs = judged.claims[judged.claims["correct"]]
    now, before = pairs["step"], pairs["match"]
    poses = relative(reference.poses[before], reference.poses[now])
    return Relations(np.column_stack([reference.times[before], reference.times[now]]), poses)


def _relation_errors(estimate: Trajectory, known: Relations, tolerance: float) -> RelationErrors | None:
    """Return the estimate's errors in the relations of which it has both poses."""
    pairs = match_times(known.times.ravel(), estimate.times, tolerance).reshape(-1, 2)
    both = (pairs >= 0).all(axis=1)
    return relation_errors(estimate.poses, pairs[both], known.poses[both]) if both.any() else None
