"""The table of runs: a CSV file that grows by a line for each run that ends, and is read again when work resumes."""

from __future__ import annotations

import csv
import io
import math
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from cyclic_env.atomic_write import write_text_atomically
from cyclic_env.errors import ConfigError
from scripts.comparison.measures import MEASURES, TIMES
from scripts.comparison.provenance import DIGESTS, VERSIONS
from scripts.comparison.suite import KEY, Job

COLUMNS = (*KEY, "privileged", "status", "error", *MEASURES, *TIMES, *DIGESTS, *VERSIONS)
TEXT = (*(name for name in KEY if name != "seed"), "status", "error", "coverage_curve", *DIGESTS, *VERSIONS)
DONE, FAILED = "done", "failed"

Row = dict[str, Any]
Runs = Any
"""A DataFrame; typed as Any, since pandas' types don't know what kind of values a column has."""


class RunTable:
    """The rows of a CSV file, by the keys of their runs.

    Parameters
    ----------
    path : Path
        Created when the first row is added.

    Raises
    ------
    ConfigError
        If the file is not a table of runs.

    Attributes
    ----------
    damaged : int
        Number of lines that could not be read. Their runs have to be run again; a copy of the damaged file is kept
        next to it.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.rows: dict[tuple[str, ...], dict[str, str]] = {}
        self.damaged = 0
        if path.exists():
            self.rows, self.damaged = self._read()
        if self.damaged:
            shutil.copyfile(path, path.with_suffix(".damaged.csv"))
            self.tidy()

    def _read(self) -> tuple[dict[tuple[str, ...], dict[str, str]], int]:
        """Return the rows of the file, and the number of its lines that are damaged."""
        try:
            lines = self.path.read_text(encoding="utf-8").split("\n")
        except UnicodeDecodeError as error:
            raise ConfigError(f"{self.path} is not a table of runs, since it is not text; move it away.") from error
        if lines[0] != ",".join(COLUMNS):
            raise ConfigError(
                f"{self.path} is not a table of runs, or is one of another version (see its first line); move it away."
            )
        rows, damaged = {}, int(lines[-1] != "")  # a line that was written completely ends with a line break
        for line in lines[1:-1]:
            values = next(csv.reader([line]), [])
            row = dict(zip(COLUMNS, values, strict=False))
            if len(values) == len(COLUMNS) and row["status"] in (DONE, FAILED) and row["seed"].isdecimal():
                rows[tuple(row[name] for name in KEY)] = row
            else:
                damaged += 1
        return rows, damaged

    def __contains__(self, job: Job) -> bool:
        return job.key in self.rows

    def add(self, row: Row) -> None:
        """Add the row of a run that has ended, here and in the file."""
        text = self.text_of(row)
        self.rows[tuple(text[name] for name in KEY)] = text
        with self.path.open("a", encoding="utf-8", newline="") as file:
            if file.tell() == 0:
                file.write(",".join(COLUMNS) + "\n")
            file.write(_line(text))

    @staticmethod
    def text_of(row: Row) -> dict[str, str]:
        """Return a row as the text that is written to the file."""
        return {name: _as_text(row.get(name)) for name in COLUMNS}

    def tidy(self) -> None:
        """Rewrite the file with each run once, in order, including rows that another process has added."""
        self.rows = self._read()[0] | self.rows
        order = sorted(self.rows.values(), key=lambda row: [row[name].zfill(9) for name in KEY])
        write_text_atomically(self.path, ",".join(COLUMNS) + "\n" + "".join(_line(row) for row in order))

    def stale(self, job: Job, current: Mapping[str, str]) -> bool:
        """Tell whether the row of a run was made by different code or on a different plan."""
        return any(self.rows[job.key][name] != current[name] for name in DIGESTS)

    def frame(self, jobs: Sequence[Job] | None = None) -> Runs:
        """Return the rows of runs that are done, by default of all jobs; numbers and bools are no longer text."""
        rows = self.rows.values() if jobs is None else [self.rows[job.key] for job in jobs if job in self]
        done = [row for row in rows if row["status"] == DONE]
        return pd.DataFrame([{name: _from_text(name, row[name]) for name in COLUMNS} for row in done])


def _line(row: Mapping[str, str]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerow([row[name] for name in COLUMNS])
    return text.getvalue()


def _as_text(value: Any) -> str:
    """Return a value as text for the file: numbers with all their digits, nothing for NaN, one line of text."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    return repr(float(value)) if isinstance(value, float) else " ".join(str(value).split())


def _from_text(name: str, text: str) -> Any:
    if name in TEXT:
        return text
    if text in ("True", "False"):
        return text == "True"
    return float(text) if text else math.nan
