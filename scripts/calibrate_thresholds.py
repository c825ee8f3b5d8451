"""Calibrate the threshold of each similarity measure on generated training plans; write agents/knn/thresholds.json."""

from __future__ import annotations

if __name__ == "__main__":
    from _cli import run_script

    run_script(__file__)

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

from agents.knn.config import THRESHOLDS
from cyclic_env.atomic_write import check_writable, write_text_atomically
from cyclic_env.errors import ConfigError
from cyclic_env.floor_plans.generator.spec import SPLITS
from scripts._cli import command, interruptible, progress_bar
from scripts.paper.cache import Cache, check_processes, run_all
from scripts.paper.thresholds import thresholds_file, training_runs

PLANS = 20


@command
def main(arguments: Sequence[str] | None) -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--plans", type=int, default=PLANS, help=f"how many of the train split (default {PLANS})")
    parser.add_argument("--out", type=Path, default=THRESHOLDS, help="file to write (default the explorer's own)")
    parser.add_argument("--cache", type=Path, default=Path("out/paper/cache"), help="folder that keeps finished runs")
    parser.add_argument("--processes", type=int, default=2, help="at once (default 2)")
    args = parser.parse_args(arguments)
    most = SPLITS["train"].plans
    if not 1 <= args.plans <= most:
        raise ConfigError(f"--plans is {args.plans}; expected 1 to {most}, the plans of the train split.")
    check_processes(args.processes)
    check_writable(args.out)
    check_writable(args.cache / "file")
    cache, runs = Cache(args.cache), training_runs(args.plans)
    with interruptible() as interruption, progress_bar(unit="run") as progress:
        for done, count in run_all(cache, runs, args.processes):
            progress.total = count
            progress.update(done - progress.n)
    if interruption:
        raise interruption.stopped("finished runs are kept, and used next time.")
    records = [cache.record(settings) for settings in runs]
    command_line = f"python scripts/calibrate_thresholds.py --plans {args.plans}"
    result = thresholds_file(records, args.plans, command_line)
    write_text_atomically(args.out, json.dumps(result, indent=1) + "\n")
    for name, entry in result["measures"].items():
        print(f"{name:>12}  " + "  ".join(f"{key} {value:.4f}" for key, value in entry.items()))
    print(f"\nwritten: {args.out}")
