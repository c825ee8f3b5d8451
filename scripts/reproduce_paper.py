"""Reproduce the paper of Abdulnabi and Esmail (2022) and test its claims; write a report with figures and tables."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # agents are not installed, but run from the checkout
if __name__ == "__main__":  # Ctrl-C while the packages load
    signal.signal(
        signal.SIGINT, lambda *_: (print("\nreproduce_paper.py: nothing done yet", file=sys.stderr), os._exit(130))
    )

import argparse
from collections.abc import Sequence

from cyclic_env.atomic_write import check_writable
from cyclic_env.console import ProgressLine, say
from cyclic_env.errors import CyclicLoopError
from scripts.paper.cache import check_processes
from scripts.paper.sections import FULL, QUICK


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code: 0, 2 for bad input, 130 after Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer seeds and settings")
    parser.add_argument("--out", type=Path, default=Path("out/paper"), help="folder for the files (default out/paper)")
    parser.add_argument("--docs", type=Path, metavar="FOLDER", help="also write paper.md and small pictures there")
    parser.add_argument("--processes", type=int, default=2, help="at once (default 2)")
    args = parser.parse_args(arguments)
    progress = ProgressLine()
    try:
        import cyclic_env.rendering.figures  # noqa: F401 (it says what to do where matplotlib is missing)
        from scripts.paper.reproduction import Reproduction

        check_processes(args.processes)
        folders = [args.out, args.out / "cache", *([] if args.docs is None else [args.docs / "paper"])]
        for folder in folders:
            check_writable(folder / "file")
        scope = QUICK if args.quick else FULL
        written = Reproduction(
            scope=scope, folder=args.out, processes=args.processes, docs=args.docs, tick=progress.show
        ).run()
    except (CyclicLoopError, OSError) as error:
        progress.clear()
        print(f"reproduce_paper.py: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        progress.clear()
        print("\nreproduce_paper.py: stopped; what was worked out is kept, and used next time.", file=sys.stderr)
        return 130
    progress.clear()
    say(f"written: {written[0]}, and {len(written) - 1} figures and tables")
    return 0


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.exit(main())
