"""What commands print: results on stdout, and how far they are on stderr."""

from __future__ import annotations

import math
import os
import shutil
import sys
import time
from pathlib import Path
from typing import TextIO

REDRAW_S = 0.2
"""Seconds between two drawings of the progress line on a terminal."""
REPORT_S = 30.0
"""Seconds between two lines of progress where there is no terminal, as in a log file."""


def say(text: str) -> None:
    """Print to stdout at once; if that can't be, as after ``| head`` or on a full disk, work goes on without."""
    try:
        print(text, flush=True)
    except OSError as error:
        if not isinstance(error, BrokenPipeError):
            print(f"can't print: {error.strerror}; the rest is not shown.", file=sys.stderr)
        with Path(os.devnull).open("w") as nowhere:  # what is left of the text, too, which Python writes when it ends
            os.dup2(nowhere.fileno(), sys.stdout.fileno())


class ProgressLine:
    """How far a long piece of work is, on stderr: a line drawn over itself, or without a terminal a line now and then.

    Parameters
    ----------
    stream : text stream, optional
        In place of stderr.
    """

    def __init__(self, stream: TextIO | None = None) -> None:
        self._stream = sys.stderr if stream is None else stream
        self._terminal = self._stream.isatty()
        self._every = REDRAW_S if self._terminal else REPORT_S
        self._shown = -math.inf if self._terminal else time.monotonic()
        self._width = 0

    def show(self, text: str) -> None:
        """Show the text, unless another was shown a moment ago."""
        now = time.monotonic()
        if now - self._shown < self._every:
            return
        self._shown = now
        if self._terminal:
            text = text[: shutil.get_terminal_size().columns - 1]  # a longer one would not be drawn over
            self._stream.write("\r" + text.ljust(self._width))
            self._width = len(text)
        else:
            self._stream.write(text + "\n")
        self._stream.flush()

    def clear(self) -> None:
        """Wipe the line from the terminal."""
        if self._width:
            self._stream.write("\r" + " " * self._width + "\r")
            self._stream.flush()
            self._width = 0
