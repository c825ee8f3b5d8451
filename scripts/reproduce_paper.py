"""Reproduce the paper of Abdulnabi and Esmail (2022) and test its claims; write a report with figures and tables."""

from __future__ import annotations

if __name__ == "__main__":
    from _cli import run_script

    run_script(__file__)

import argparse
from collections.abc import Sequence
from pathlib import Path

from cyclic_env.atomic_write import check_writable
from cyclic_env.errors import ConfigError
from scripts._cli import command, interruptible
from scripts.paper.experiments import PAPER, PAPER_ALL, QUICK

PROCESSES_MAX = 64


@command
def main(arguments: Sequence[str] | None) -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer starts and plans")
    parser.add_argument("--all", action="store_true", help="also vary the readings, and sweep the noise")
    parser.add_argument("--out", type=Path, default=Path("out/paper"), help="folder for the files (default out/paper)")
    parser.add_argument("--docs", type=Path, metavar="FOLDER", help="also write paper.md and small pictures there")
    parser.add_argument("--processes", type=int, default=2, help="at once (default 2)")
    args = parser.parse_args(arguments)
    import cyclic_env.rendering.figures  # noqa: F401 (it says what to do where matplotlib is missing)
    from scripts.paper.report import Reproduction

    if not 1 <= args.processes <= PROCESSES_MAX:
        raise ConfigError(f"--processes is {args.processes}; expected a whole number from 1 to {PROCESSES_MAX}.")
    for folder in [args.out, *([] if args.docs is None else [args.docs / "paper"])]:
        check_writable(folder / "file")
    scope = PAPER_ALL if args.all else QUICK if args.quick else PAPER
    with interruptible() as interruption:
        written = Reproduction(scope=scope, folder=args.out, processes=args.processes, docs=args.docs).run()
    if interruption:
        raise interruption.stopped("finished runs are kept, and used next time.")
    print(f"written: {written[0]}, and {len(written) - 1} figures and tables")
