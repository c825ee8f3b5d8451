"""Find the loops of a recorded run, by default a real robot's in Killian Court; write figure, claims, track, scores."""

from __future__ import annotations

if __name__ == "__main__":
    from _cli import run_script

    run_script(__file__)

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cyclic_env import ConfigError, FloorPlan, RobotLog, load_floor_plan, read_robot_log
from cyclic_env.atomic_write import check_outputs, write_text_atomically
from cyclic_env.evaluation.judge import JudgeReport, judge_run
from cyclic_env.trajectory.io import write_g2o, write_tum
from cyclic_env.trajectory.metrics import rigid_alignment
from cyclic_env.trajectory.poses import compose, relative
from cyclic_env.trajectory.readers import Claims, Trajectory
from cyclic_env.validation import check_choice
from scripts._arguments import OptionalFile, OptionalText
from scripts._cli import command, progress_bar
from scripts._judgement import report_text
from scripts._tables import format_rows
from scripts.recorded.detectors import DETECTORS, Detection, detect

FILES = ("run.png", "claims.csv", "track.tum", "reference.tum", "odometry.tum", "pose_graph.g2o")
CHAIN_INFORMATION = np.diag([2500.0, 2500.0, 1e4])
"""Of the edges between successive poses of the exported graph: 2 cm and half a degree."""
GATED = "mapper"
"""The detector that has a gate."""
GATE_MAX = 1.0
PER_GATE = ("row_recall", "claims", "false_claims", "revisits", "revisits_recognised", "cycles_closed")


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of the command."""

    log: str = "killian_run"
    """a log in maps/recorded, or a file of any format that read_robot_log reads"""
    map: OptionalText = None
    """a plan's name or file, in whose frame the log's reference is (default: the log's, else none)"""
    detector: str = "mapper"
    """mapper, or beside it: paper (its table, by position and appearance), position (odometry alone), scans, sectors
    or panorama (appearance alone)"""
    gate: str = "0.06"
    """of the mapper: how far off a place may seem, as a share of the way there; several with commas are all scored"""
    out: Path = Path("out/recorded")
    """folder for the files"""
    json: OptionalFile = None
    """file for the scores (default: scores.json in --out)"""


@command(Options)
def main(args: Options) -> None:
    """Run the command."""
    from scripts.recorded.figure import draw_recorded_run  # says what to do where matplotlib is missing

    check_choice("detector", args.detector, DETECTORS)
    gates = gates_of(args.gate)
    if len(gates) > 1 and args.detector != GATED:
        raise ConfigError(f"the detector {args.detector} has no gate; --gate is for {GATED}.")
    files = {name: args.out / name for name in FILES}
    scores_file = args.json or args.out / "scores.json"
    check_outputs([*files.values(), scores_file], inputs=[Path(args.log)])
    log = read_robot_log(args.log)
    if log.reference is None:
        if args.map is not None:
            raise ConfigError(f"{args.log} has no reference poses, so it can't be placed on a map; leave --map out.")
        del files["reference.tum"]
    name = args.map or log.map_name
    plan = None if name is None or log.reference is None else load_floor_plan(name)
    detections = [run_detector(args.detector, log, gate) for gate in gates]
    reports = [judge_detection(log, plan, detection) for detection in detections]
    first, report = detections[0], reports[0]
    scores: dict[str, Any] = {"log": log.name, "scans": len(log), "detector": args.detector, "gate": gates[0]}
    scores["median_ms_per_scan"] = 1000 * float(np.median(first.seconds)) if first.seconds else None
    scores |= {"claims": len(first.claims)} if report is None else report.to_json()
    scores["gates"] = [gate_scores(*entry) for entry in zip(gates, reports, strict=True)]
    export(log, plan, first, files)
    title = f"{plan.title or plan.name}: the recorded run" if plan else log.name
    claims = None if report is None else report.judged
    draw_recorded_run(files["run.png"], title, scores_line(scores), plan, *positions(log, plan, first), claims)
    write_text_atomically(scores_file, json.dumps(scores, indent=1) + "\n")
    print(text_of(scores, report), f"\nwritten to {args.out}: {', '.join(files)}; {scores_file}", sep="\n")


def gates_of(text: str) -> list[float]:
    """Return the numbers in a text, with commas between."""
    try:
        gates = [float(word) for word in text.split(",")]
    except ValueError:
        gates = []
    if not gates or not all(0 < gate <= GATE_MAX for gate in gates):
        raise ConfigError(f"--gate is {text!r}; expected shares from 0 to {GATE_MAX:g}, with commas between.")
    return gates


def run_detector(name: str, log: RobotLog, gate: float) -> Detection:
    """Let a detector claim on a log, with a bar of progress."""
    return detect(name, log, gate, lambda scans: progress_bar(unit="scan", iterable=scans))


def reference_of(log: RobotLog, plan: FloorPlan | None) -> Trajectory | None:
    """Return the reference of a log, in the plan's frame if there is one."""
    if log.reference is None:
        return None
    pose = np.zeros(3) if plan is None or log.map_transform is None else log.map_transform
    return Trajectory(times=log.times, poses=compose(pose, log.reference))


def judge_detection(log: RobotLog, plan: FloorPlan | None, detection: Detection) -> JudgeReport | None:
    """Return what the judge says of a detection; None without a reference."""
    reference = reference_of(log, plan)
    if reference is None:
        return None
    later, earlier = detection.claims.T.astype(np.float64)
    return judge_run(
        reference,
        Claims(times=later, matches=earlier, by_step=True, scores=detection.scores),
        estimate=None if detection.track is None else Trajectory(times=log.times, poses=detection.track),
        plan=plan,
    )


def gate_scores(gate: float, report: JudgeReport | None) -> dict[str, Any]:
    """Return what the judge says with a gate."""
    plain = {} if report is None else report.to_json()
    return {"gate": gate, **{name: plain.get(name) for name in PER_GATE}}


def positions(
    log: RobotLog, plan: FloorPlan | None, detection: Detection
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Return track, odometry and map points as they are drawn: moved as a whole onto the reference, if there is one.

    Without a track the claims are drawn on the reference. The odometry begins where the track does.
    """
    reference = reference_of(log, plan)
    track, points = detection.track, detection.points
    if track is None:
        track = log.odometry if reference is None else reference.poses
    elif reference is not None:
        pose = rigid_alignment(track[:, :2], reference.poses[:, :2])
        track = compose(pose, track)
        points = None if points is None else compose(pose, np.column_stack([points, np.zeros(len(points))]))[:, :2]
    odometry = compose(track[0], relative(log.odometry[0], log.odometry))
    return track[:, :2], odometry[:, :2], points


def export(log: RobotLog, plan: FloorPlan | None, detection: Detection, files: dict[str, Path]) -> None:
    """Write claims, trajectories and pose graph, for `judge.py`, evo and g2o."""
    times = log.times.tolist()
    scores = None if detection.scores is None else detection.scores.tolist()
    lines = ["time,match_time" + (",score" if scores else "")]
    for i, (later, earlier) in enumerate(detection.claims.tolist()):
        lines.append(f"{times[later]:.6f},{times[earlier]:.6f}" + (f",{scores[i]!r}" if scores else ""))
    write_text_atomically(files["claims.csv"], "\n".join(lines) + "\n")
    reference, track = reference_of(log, plan), log.odometry if detection.track is None else detection.track
    write_tum(files["odometry.tum"], log.times, log.odometry)
    write_tum(files["track.tum"], log.times, track)
    if reference is not None:
        write_tum(files["reference.tum"], log.times, reference.poses)
    chain = [(i, i + 1, relative(track[i], track[i + 1]), CHAIN_INFORMATION) for i in range(len(log) - 1)]
    write_g2o(files["pose_graph.g2o"], track, [*chain, *detection.edges])


def name_of(scores: dict[str, Any]) -> str:
    """Return the detector's name, with its gate if it has one."""
    gated = scores["detector"] == GATED
    return f"{scores['detector']}, gate {scores['gate']:g}" if gated else scores["detector"]


def scores_line(scores: dict[str, Any]) -> str:
    """Return the scores in one line."""
    parts = [name_of(scores)]
    if "row_recall" in scores:
        if scores["cycles_total"]:
            parts.append(f"{scores['cycles_closed']} of {scores['cycles_total']} cycles closed")
        parts += [
            f"{scores['false_claims']} of {scores['claims']} claims false",
            f"{scores['revisits_recognised']} of {scores['revisits']} revisits recognised",
            f"row recall {scores['row_recall']:.3f} (n = {scores['row_returns']:,})",
        ]
    else:
        parts.append(f"{scores['claims']:,} claims, not judged: the log has no reference")
    return "   ".join(parts)


def text_of(scores: dict[str, Any], report: JudgeReport | None) -> str:
    """Return what the command prints of the scores."""
    head = {"run": f"{scores['log']}, {scores['scans']:,} scans, {name_of(scores)}"}
    if scores["median_ms_per_scan"] is not None:
        head["time a scan"] = f"{scores['median_ms_per_scan']:.1f} ms at the median"
    if report is None:
        return format_rows(head | {"claims": f"{scores['claims']:,}, not judged: the log has no reference"})
    rows = {
        f"gate {entry['gate']:g}": f"row recall {entry['row_recall']:.3f}, {entry['false_claims']} of "
        f"{entry['claims']} claims false, {entry['revisits_recognised']} of {entry['revisits']} events, "
        f"{entry['cycles_closed']} cycles"
        for entry in scores["gates"]
    }
    return "\n".join([format_rows(head), report_text(report), *(["", format_rows(rows)] if len(rows) > 1 else [])])
