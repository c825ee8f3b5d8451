"""Judge anyone's run: its loop closures and its trajectory, against a reference and, if there is one, on a map."""

from __future__ import annotations

if __name__ == "__main__":
    from _cli import run_script

    run_script(__file__)

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from tyro.conf import arg

from agents.slam.closure_price import ClosurePrice, price_run
from cyclic_env import ConfigError, RobotLog, load_floor_plan, read_robot_log
from cyclic_env.atomic_write import check_outputs, write_text_atomically
from cyclic_env.evaluation.claim_matching import TOLERANCE, match_claims
from cyclic_env.evaluation.judge import JudgeReport, judge_run
from cyclic_env.evaluation.scan_overlap import Scans
from cyclic_env.trajectory.poses import compose
from cyclic_env.trajectory.readers import Claims, Trajectory, read_claims, read_relations, read_trajectory
from scripts._arguments import Flag, OptionalFile, OptionalText
from scripts._cli import command, progress_bar
from scripts._judgement import report_text

EXAMPLES = """examples:
  python scripts/judge.py --trajectory slam.tum --reference truth.tum --claims claims.csv --map map.yaml
  python scripts/judge.py --trajectory graph.g2o --claims graph.g2o --reference truth.g2o
  python scripts/judge.py --log killian_run --claims out/recorded/claims.csv --price"""


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of the command."""

    claims: Path
    """loop closures: a CSV table with the columns time,match_time or step,match (and score; and x,y,heading of the
    closure), or a g2o file with loop edges"""
    trajectory: OptionalFile = None
    """what the SLAM system says: TUM or g2o (default: only the claims are judged)"""
    reference: OptionalFile = None
    """the truth: TUM or g2o (default: the log's)"""
    map: OptionalText = None
    """a plan's name, or the YAML file of a plan or of a map of ROS (default: the log's, else none)"""
    map_pose: Annotated[tuple[float, float, float] | None, arg(metavar="X Y HEADING", help_behavior_hint="")] = None
    """pose of the reference's frame in the map's: x, y (m) and heading (radians; default: the log's, else 0 0 0)"""
    log: OptionalText = None
    """a robot's log, whose scans are compared for their overlap"""
    odometry: OptionalFile = None
    """the odometry for --price: TUM (default: the log's)"""
    relations: OptionalFile = None
    """known relative poses: timestamp1 timestamp2 x y z roll pitch yaw (default: those of the reference at returns)"""
    tolerance: float = TOLERANCE
    """seconds by which time stamps of the same moment may differ"""
    price: Flag = False
    """put the claims into a pose graph, plain and robust, and say what the false ones cost"""
    json: OptionalFile = None
    """file for the report"""


@command(Options, EXAMPLES)
def main(args: Options) -> None:
    """Run the command."""
    inputs = [args.claims, args.trajectory, args.reference, args.odometry, args.relations]
    check_outputs([args.json] if args.json else [], inputs=[path for path in inputs if path])
    if not args.tolerance >= 0:
        raise ConfigError(f"--tolerance is {args.tolerance:g}; expected seconds, at least 0.")
    log = None if args.log is None else read_robot_log(args.log)
    reference, claims = the_reference(args, log), read_claims(args.claims)
    name = args.map or (log.map_name if log is not None else None)
    report = judge_run(
        reference,
        claims,
        estimate=None if args.trajectory is None else read_trajectory(args.trajectory),
        plan=None if name is None else load_floor_plan(name),
        scans=None if log is None else scans_of(log),
        relations=None if args.relations is None else read_relations(args.relations),
        tolerance=args.tolerance,
    )
    price = the_price(args, log, reference, claims, report) if args.price else None
    if args.json is not None:
        plain = report.to_json() | {"price": None if price is None else asdict(price)}
        write_text_atomically(args.json, json.dumps(plain, indent=1) + "\n")
    print(report_text(report, price))


def the_reference(args: Options, log: RobotLog | None) -> Trajectory:
    """Return the reference, in the map's frame."""
    pose = args.map_pose
    if args.reference is not None:
        reference = read_trajectory(args.reference)
    elif log is None or log.reference is None:
        raise ConfigError("there is no reference; give --reference, or a --log that has one.")
    else:
        reference, pose = Trajectory(times=log.times, poses=log.reference), pose or log.map_transform
    return reference if pose is None else Trajectory(times=reference.times, poses=compose(pose, reference.poses))


def scans_of(log: RobotLog) -> Scans:
    """Return the scans of a log."""
    return Scans(times=log.times, ranges=log.ranges, laser=log.laser, laser_position=log.laser_position)


def the_price(
    args: Options, log: RobotLog | None, reference: Trajectory, claims: Claims, report: JudgeReport
) -> ClosurePrice:
    """Return what the judged claims do to the map."""
    if args.odometry is not None:
        odometry = read_trajectory(args.odometry)
    elif log is not None:
        odometry = Trajectory(times=log.times, poses=log.odometry)
    else:
        raise ConfigError("--price needs the odometry; give --odometry, or a --log.")
    matched = match_claims(claims, reference.times, args.tolerance)
    measured = matched.measured
    if measured is not None:
        measured = measured[np.searchsorted(matched.pairs[:, 0], report.judged["step"])]
    with progress_bar(unit="graph") as progress:
        return price_run(
            reference, odometry, report.judged, measured, tolerance=args.tolerance, on_step=progress.update
        )
