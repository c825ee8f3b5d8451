"""What all commands have in common: interruptions, closed pipes, one line for an error, exit codes, progress.

A script begins with::

    if __name__ == "__main__":
        from _cli import run_script

        run_script(__file__)

and has a function ``main`` that is made a `command`.

Exit codes: 0; 1 if the command's answer is no, such as for a replay that differs; 2 for bad input and for files that
can't be read or written; 128 + the number of the signal, so 130 after Ctrl-C, for a command that was interrupted.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import importlib.util
import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TextIO, TypeVar

if TYPE_CHECKING:
    from tqdm import tqdm

T = TypeVar("T")

SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
"""What interrupts a command: Ctrl-C, ``kill``, and a terminal that is closed."""

PACKAGES = ("pandas", "tabulate", "tqdm", "tyro")
"""Packages of the extra ``cli``."""

REPORT_S = 30.0
"""Seconds between two lines of progress in a log file."""


def run_script(file: str) -> NoReturn:
    """Run the command of a script that was started by its file, and exit.

    The script is imported as a module of the package `scripts`, with the checkout first on the path, since neither
    `scripts` nor `agents` is installed. Until that is done a signal ends the process at once.
    """
    root, name = Path(file).resolve().parents[1], Path(file).stem
    sys.path[0] = str(root)

    def give_up(signum: int, _: Any) -> NoReturn:
        print(f"\n{name}.py: stopped before it began.", file=sys.stderr, flush=True)
        os._exit(128 + signum)

    _handle_signals(give_up)
    for stream in (sys.stdout, sys.stderr):
        stream.reconfigure(errors="backslashreplace")  # pyright: ignore[reportAttributeAccessIssue] (file names can be any bytes)
    sys.stdout, sys.stderr = _LastingStream(sys.stdout), _LastingStream(sys.stderr)  # pyright: ignore[reportAttributeAccessIssue]
    missing = [package for package in PACKAGES if importlib.util.find_spec(package) is None]
    if missing:
        sys.exit(f'{name}.py: {", ".join(missing)} is missing: pip install -e ".[cli]" in the checkout.')
    main = importlib.import_module(f"scripts.{name}").main
    _handle_signals(_interrupt)
    sys.unraisablehook = _send_again
    sys.exit(main())


def _handle_signals(handler: Callable[[int, Any], Any]) -> None:
    for signum in SIGNALS:
        if signum == signal.SIGINT or signal.getsignal(signum) != signal.SIG_IGN:  # nohup ignores SIGHUP
            signal.signal(signum, handler)


def _interrupt(signum: int, _: Any) -> NoReturn:
    raise KeyboardInterrupt(signum)


def _send_again(unraisable: Any) -> None:
    """Resend a signal that arrived where no exception can be raised, such as in a callback of LLVM that loads code."""
    if isinstance(unraisable.exc_value, KeyboardInterrupt):
        threading.Timer(0.1, os.kill, (os.getpid(), _signal_of(unraisable.exc_value))).start()
    else:
        sys.__unraisablehook__(unraisable)


class _LastingStream:
    """An output stream that falls silent when nobody reads it any more or its disk is full, so that work goes on."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        try:
            self._stream.write(text)
            if "\n" in text:
                self._stream.flush()
        except OSError as error:
            self._fall_silent(error)
        return len(text)

    def flush(self) -> None:
        try:
            self._stream.flush()
        except OSError as error:
            self._fall_silent(error)

    def _fall_silent(self, error: OSError) -> None:
        with Path(os.devnull).open("w") as nowhere:  # which also takes what is left in the buffer
            os.dup2(nowhere.fileno(), self._stream.fileno())
        if not isinstance(error, BrokenPipeError):
            print(f"can't write to {self._stream.name}: {error.strerror}; the rest is not shown.", file=sys.stderr)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def command(options: type[T], examples: str = "") -> Callable[[Callable[[T], int | None]], Callable[..., int]]:
    """Turn a function of the options into a command that parses them, prints one line for an error, and returns a code.

    Parameters
    ----------
    options : type
        A dataclass, whose fields are the options.
    examples : str
        Shown by ``--help`` below the docstring of the script.
    """

    def decorate(main: Callable[[T], int | None]) -> Callable[..., int]:
        name = Path(main.__code__.co_filename).name
        description = f"{sys.modules[main.__module__].__doc__}\n\n{examples}".strip()

        @functools.wraps(main)
        def run(arguments: Sequence[str] | None = None) -> int:
            from cyclic_env.errors import CyclicLoopError

            try:
                from scripts._arguments import parse

                return main(parse(options, arguments, name, description)) or 0
            except (CyclicLoopError, OSError, MemoryError) as error:
                message, code = str(error) or type(error).__name__, 2
            except Stopped as stop:
                message, code = f"stopped; {stop}", 128 + stop.signum
            except KeyboardInterrupt as interrupt:
                message, code = "stopped.", 128 + _signal_of(interrupt)
            print(f"{name}: {message}", file=sys.stderr)
            return code

        return run

    return decorate


class Stopped(Exception):
    """A command was interrupted by the signal `signum`; the message says what it has kept."""

    def __init__(self, kept: str, signum: int) -> None:
        super().__init__(kept)
        self.signum = signum


class Interruption:
    """Whether a block was interrupted, and by which signal."""

    signum: int = 0

    def __bool__(self) -> bool:
        return self.signum != 0

    def stopped(self, kept: str) -> Stopped:
        """Return the error that ends the command; `kept` says what is done and where it is."""
        return Stopped(kept, self.signum)


@contextlib.contextmanager
def interruptible() -> Iterator[Interruption]:
    """Continue after the block if it is interrupted, so that what it has done can be kept."""
    interruption = Interruption()
    try:
        yield interruption
    except KeyboardInterrupt as interrupt:
        interruption.signum = _signal_of(interrupt)


def _signal_of(interrupt: KeyboardInterrupt) -> int:
    return interrupt.args[0] if interrupt.args else signal.SIGINT


def progress_bar(total: int | None = None, unit: str = "it", **options: Any) -> tqdm:
    """Return a progress bar on stderr, removed at its end; where stderr is no terminal, a line every `REPORT_S`."""
    from tqdm import tqdm

    class Lines(tqdm):
        printed = time.monotonic()

        def display(self, msg: str | None = None, pos: int | None = None) -> None:
            if msg is None and time.monotonic() - self.printed >= REPORT_S:
                self.printed = time.monotonic()
                print(self, file=sys.stderr)

        def clear(self, nolock: bool = False) -> None:
            pass

    kind = tqdm if sys.stderr.isatty() else Lines
    columns, rows = shutil.get_terminal_size()  # never 0, unlike the size that tqdm asks for
    return kind(total=total, unit=unit, leave=False, ncols=columns - 1, nrows=rows, miniters=0, **options)
