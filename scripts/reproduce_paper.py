"""Reproduce the paper of Abdulnabi and Esmail (2022) and test its claims; write a report with figures and tables."""

from __future__ import annotations

if __name__ == "__main__":
    from _cli import run_script

    run_script(__file__)

import argparse
from collections.abc import Sequence
from pathlib import Path

from cyclic_env.atomic_write import check_writable
from scripts._cli import command, interruptible, progress_bar
from scripts.paper.cache import check_processes
from scripts.paper.sections import FULL, QUICK


@command
def main(arguments: Sequence[str] | None) -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer seeds and settings")
    parser.add_argument("--out", type=Path, default=Path("out/paper"), help="folder for the files (default out/paper)")
    parser.add_argument("--docs", type=Path, metavar="FOLDER", help="also write paper.md and small pictures there")
    parser.add_argument("--processes", type=int, default=2, help="at once (default 2)")
    args = parser.parse_args(arguments)
    import cyclic_env.rendering.figures  # noqa: F401 (it says what to do where matplotlib is missing)
    from scripts.paper.reproduction import Reproduction

    check_processes(args.processes)
    folders = [args.out, args.out / "cache", *([] if args.docs is None else [args.docs / "paper"])]
    for folder in folders:
        check_writable(folder / "file")
    scope = QUICK if args.quick else FULL
    with interruptible() as interruption, progress_bar(bar_format="{desc}, {elapsed}") as progress:
        written = Reproduction(
            scope=scope, folder=args.out, processes=args.processes, docs=args.docs, tick=progress.set_description_str
        ).run()
    if interruption:
        raise interruption.stopped("what was worked out is kept, and used next time.")
    print(f"written: {written[0]}, and {len(written) - 1} figures and tables")
