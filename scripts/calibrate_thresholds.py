"""Calibrate the threshold of each similarity measure on generated training plans; write agents/knn/thresholds.json."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # agents are not installed, but run from the checkout
if __name__ == "__main__":  # Ctrl-C while the packages load
    signal.signal(
        signal.SIGINT, lambda *_: (print("\ncalibrate_thresholds.py: nothing done yet", file=sys.stderr), os._exit(130))
    )

import argparse
import json
from collections.abc import Sequence

from agents.knn.config import THRESHOLDS
from cyclic_env.atomic_write import check_writable, write_text_atomically
from cyclic_env.console import ProgressLine, say
from cyclic_env.errors import ConfigError, CyclicLoopError
from cyclic_env.floor_plans.generator.spec import SPLITS
from scripts.paper.cache import Cache, check_processes, run_all
from scripts.paper.thresholds import thresholds_file, training_runs

PLANS = 20


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code: 0, 2 for bad input, 130 after Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--plans", type=int, default=PLANS, help=f"how many of the train split (default {PLANS})")
    parser.add_argument("--out", type=Path, default=THRESHOLDS, help="file to write (default the explorer's own)")
    parser.add_argument("--cache", type=Path, default=Path("out/paper/cache"), help="folder that keeps finished runs")
    parser.add_argument("--processes", type=int, default=2, help="at once (default 2)")
    args = parser.parse_args(arguments)
    progress = ProgressLine()
    try:
        most = SPLITS["train"].plans
        if not 1 <= args.plans <= most:
            raise ConfigError(f"--plans is {args.plans}; expected 1 to {most}, the plans of the train split.")
        check_processes(args.processes)
        check_writable(args.out)
        check_writable(args.cache / "file")
        cache, runs = Cache(args.cache), training_runs(args.plans)
        for done, count in run_all(cache, runs, args.processes):
            progress.show(f"{done} of {count} runs")
        progress.clear()
        records = [cache.record(settings) for settings in runs]
        command = f"python scripts/calibrate_thresholds.py --plans {args.plans}"
        result = thresholds_file(records, args.plans, command)
        write_text_atomically(args.out, json.dumps(result, indent=1) + "\n")
    except (CyclicLoopError, OSError) as error:
        progress.clear()
        print(f"calibrate_thresholds.py: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        progress.clear()
        print("\ncalibrate_thresholds.py: stopped; finished runs are kept, and used next time.", file=sys.stderr)
        return 130
    for name, entry in result["measures"].items():
        say(f"{name:>12}  " + "  ".join(f"{key} {value:.4f}" for key, value in entry.items()))
    say(f"\nwritten: {args.out}")
    return 0


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.exit(main())
