"""A folder that keeps the results of slow computations, and processes that compute those that are missing."""

from __future__ import annotations

import hashlib
import json
import signal
from collections.abc import Callable, Sequence
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from joblib import Memory, Parallel, delayed, parallel_config

from cyclic_env import __version__
from scripts._cli import progress_bar
from scripts.paper.runs import RunRecord, RunSettings, run_explorer

ROOT = Path(__file__).resolve().parents[2]
SOURCES = ("agents/knn/*", "agents/slam/*.py", "agents/exploration/*.py", "cyclic_env/**/*.py", "maps/*.yaml")
"""Patterns of the files, below the root, that results depend on."""
LIBRARIES = ("numpy", "scipy", "numba", "pymunk", "shapely")


@lru_cache(maxsize=1)
def code_version() -> str:
    """Return the package's version and a digest of all code and data that a run depends on."""
    digest = hashlib.sha256(json.dumps({name: version(name) for name in LIBRARIES}).encode())
    for file in sorted({file for pattern in SOURCES for file in ROOT.glob(pattern) if file.is_file()}):
        if "rendering" not in file.parts:
            digest.update(file.relative_to(ROOT).as_posix().encode() + b"\0" + file.read_bytes())
    return f"{__version__}-{digest.hexdigest()[:12]}"


def _run(settings: RunSettings, code: str) -> RunRecord:
    return run_explorer(settings)


class Store:
    """Stored results, found by what they depend on: the arguments and the code.

    Parameters
    ----------
    folder : Path
    processes : int
        Greatest number of runs at once.
    """

    def __init__(self, folder: Path, processes: int = 2) -> None:
        self._memory = Memory(folder, verbose=0)
        self._run: Any = self._memory.cache(_run)
        self.processes = processes

    def record(self, settings: RunSettings) -> RunRecord:
        """Return the record of a run, which takes place only if no record is stored."""
        return self._run(settings, code_version())

    def result(self, work: Callable[..., Any], *arguments: Any) -> Any:
        """Return the result of a module's function, which is called only if no result for the arguments is stored."""
        return self._memory.cache(work)(*arguments)

    def missing(self, runs: Sequence[RunSettings]) -> list[RunSettings]:
        """Return the runs without a stored record."""
        code = code_version()
        return [settings for settings in runs if not self._run.check_call_in_cache(settings, code)]

    def run_all(self, runs: Sequence[RunSettings]) -> None:
        """Run those without a record, several at once, and show progress; finished runs survive an interruption."""
        code, left = code_version(), self.missing(runs)
        with (
            parallel_config("loky", n_jobs=self.processes, initializer=_ignore_interrupts),
            progress_bar(total=len(runs), unit="run", initial=len(runs) - len(left)) as progress,
        ):
            finished: Any = Parallel(return_as="generator_unordered")(
                delayed(_keep)(self._run, settings, code) for settings in left
            )
            for _ in finished:
                progress.update()


def _keep(run: Any, settings: RunSettings, code: str) -> None:
    run(settings, code)


def _ignore_interrupts() -> None:
    """Leave Ctrl-C to the parent process, which ends its workers."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
