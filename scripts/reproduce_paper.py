"""Reproduce the paper of Abdulnabi and Esmail (2022) and test its claims; write a report with figures and tables."""

from __future__ import annotations

if __name__ == "__main__":
    from _cli import run_script

    run_script(__file__)

from dataclasses import dataclass
from pathlib import Path

from cyclic_env.atomic_write import check_writable
from scripts._arguments import Flag, OptionalFolder
from scripts._cli import command, interruptible, progress_bar
from scripts.paper.cache import check_processes
from scripts.paper.sections import FULL, QUICK


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of the command."""

    quick: Flag = False
    """fewer seeds and settings"""
    out: Path = Path("out/paper")
    """folder for the files"""
    docs: OptionalFolder = None
    """also write paper.md and small pictures there"""
    processes: int = 2
    """how many runs at once"""


@command(Options)
def main(args: Options) -> None:
    """Run the command."""
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
