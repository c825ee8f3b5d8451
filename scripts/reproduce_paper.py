"""Reproduce the paper of Abdulnabi and Esmail (2022) and test its claims; write a report with figures and tables."""

from __future__ import annotations

if __name__ == "__main__":
    from _cli import run_script

    run_script(__file__)

from dataclasses import dataclass
from pathlib import Path

from cyclic_env.atomic_write import check_writable
from cyclic_env.errors import ConfigError
from scripts._arguments import Flag, OptionalFolder
from scripts._cli import command, interruptible
from scripts.paper.experiments import PAPER, PAPER_ALL, QUICK

PROCESSES_MAX = 64


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of the command."""

    quick: Flag = False
    """fewer starts and plans"""
    all: Flag = False
    """also vary how the paper is read, and sweep the noise"""
    out: Path = Path("out/paper")
    """folder for the files"""
    docs: OptionalFolder = None
    """also write paper.md and small pictures to this folder"""
    processes: int = 2
    """number of runs at once"""


@command(Options)
def main(args: Options) -> None:
    """Run the command."""
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
