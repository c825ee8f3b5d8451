"""Measure the speed of the environment; print a table with all ratios from one run, and a verdict on each target.

Every rate is the best of five, since other work on a machine only ever slows it down.
"""

from __future__ import annotations

if __name__ == "__main__":
    from _cli import run_script

    run_script(__file__)

import json
import os
import platform
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import pymunk

import cyclic_env
from cyclic_env.atomic_write import check_writable, write_text_atomically
from scripts._arguments import Flag, OptionalFile
from scripts._cli import command, interruptible
from scripts.speed.environment import (
    measure_laser,
    measure_machine,
    measure_memory,
    measure_phases,
    measure_pool,
    measure_single_env,
    measure_start_up,
    measure_vector_env,
    measure_walls,
)
from scripts.speed.learning import measure_headings, measure_stable_baselines
from scripts.speed.rows import Row


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of the command."""

    json: OptionalFile = None
    """also write the results to this file"""
    quick: Flag = False
    """fewer steps"""
    walls: Flag = False
    """only drive into walls, 10^6 steps on every plan"""


@command(Options)
def main(args: Options) -> None:
    """Run the measurements and print them as they come."""
    if args.json:
        check_writable(args.json)
    measurements: list[Callable[[], Iterator[Row]]] = [
        measure_machine,
        measure_laser,
        measure_single_env,
        lambda: measure_vector_env(args.quick),
        measure_pool,
        measure_phases,
        measure_stable_baselines,
        lambda: measure_headings(args.quick),
        lambda: measure_memory(20 if args.quick else 200),
        measure_start_up,
    ]
    if args.walls:
        measurements = [lambda: measure_walls(1_000_000)]
    versions = f"cyclic_env {cyclic_env.__version__}, Python {platform.python_version()}, pymunk {pymunk.version}"
    print(f"{versions}, {os.cpu_count()} cores\n")
    print("| what | measurement | value | unit | target | |\n|---|---|---:|---|---|---|")
    rows: list[Row] = []
    with interruptible() as interruption:
        for measurement in measurements:
            for row in measurement():
                rows.append(row)
                print(f"| {row.what} | {row.name} | {row.formatted} | {row.unit} | {row.target} | {row.verdict} |")
    if args.json:
        results = {"versions": versions, "complete": not interruption, "results": [row.to_json() for row in rows]}
        write_text_atomically(args.json, json.dumps(results, indent=1) + "\n")
    if interruption:
        kept = f" and in {args.json}" if args.json else ""
        raise interruption.stopped(f"the {len(rows)} rows measured so far are above{kept}.")
