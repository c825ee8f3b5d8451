"""Results kept in small files, so that what was interrupted goes on where it was, and work on several processes."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from cyclic_env import __version__
from cyclic_env.atomic_write import atomic_write, write_text_atomically
from cyclic_env.errors import ConfigError, CyclicLoopError
from scripts._cli import uninterrupted
from scripts.paper.runs import ARRAYS, RunRecord, RunSettings, run_explorer

ROOT = Path(__file__).resolve().parents[2]
SOURCES = (
    "agents/knn/*.py",
    "agents/slam/*.py",
    "agents/exploration/*.py",
    "scripts/paper/*.py",
    "cyclic_env/**/*.py",
    "maps/*.yaml",
)
"""Files that results depend on: the explorer, the measurements, the environment, the floor plans."""
SHOWING = (
    *(f"scripts/paper/{name}.py" for name in ("claims", "figures", "report", "reproduction")),
    *(f"cyclic_env/rendering/{name}.py" for name in ("colors", "gif", "figures", "renderer", "scene", "primitives")),
)
"""Of these, those that only show results: a change of theirs leaves results as they are."""
LIBRARIES = ("numpy", "scipy", "numba", "pymunk", "shapely")
"""Whose versions results depend on."""


@lru_cache(maxsize=1)
def code_version() -> str:
    """Return the package's version and a hash of all that results depend on besides their settings."""
    digest = hashlib.sha256(json.dumps({name: version(name) for name in LIBRARIES}).encode())
    files = {file.relative_to(ROOT).as_posix(): file for pattern in SOURCES for file in ROOT.glob(pattern)}
    for name, file in sorted(files.items()):
        if name not in SHOWING:
            digest.update(name.encode() + b"\0" + file.read_bytes())
    return f"{__version__}-{digest.hexdigest()[:12]}"


class Cache:
    """A folder of results, each in a file that is named after what it depends on.

    Parameters
    ----------
    folder : Path
        Made if need be.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def _file(self, kind: str, settings: Mapping[str, Any], ending: str) -> Path:
        text = json.dumps([code_version(), kind, settings], sort_keys=True)
        return self.folder / f"{kind}-{hashlib.sha256(text.encode()).hexdigest()[:20]}{ending}"

    def result(self, kind: str, settings: Mapping[str, Any], work: Callable[[], Any]) -> Any:
        """Return what `work` returns, plain values that JSON knows, from its file if it is there."""
        file = self._file(kind, settings, ".json")
        try:
            return json.loads(file.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            result = work()
            write_text_atomically(file, json.dumps(result))
            return result

    def _run_file(self, settings: RunSettings) -> Path:
        config = settings.config
        used = None if config.match_scans else config.least_similarity
        return self._file("run", {**asdict(settings), "least_similarity": used}, ".npz")

    def record(self, settings: RunSettings) -> RunRecord:
        """Return the record of that run, which is made if it is not there."""
        record = self.load(settings)
        if record is None:
            record = run_explorer(settings)
            self.save(settings, record)
        return record

    def load(self, settings: RunSettings) -> RunRecord | None:
        """Return the record of that run; None if it is not there, or its file is damaged."""
        try:
            with self._run_file(settings).open("rb") as file, np.load(file, allow_pickle=False) as data:
                arrays = {name: data[name] for name in ARRAYS}
                return RunRecord(metrics=json.loads(str(data["metrics"])), **arrays)
        except Exception:  # a damaged file's bytes can be anything
            return None

    def save(self, settings: RunSettings, record: RunRecord) -> None:
        """Keep the record of a run."""
        values = {name: getattr(record, name) for name in ARRAYS} | {"metrics": np.array(json.dumps(record.metrics))}
        with atomic_write(self._run_file(settings)) as part:
            np.savez_compressed(part, **values)  # pyright: ignore[reportArgumentType]


def check_processes(processes: int) -> None:
    """Check how many processes are wanted at once.

    Raises
    ------
    ConfigError
        If there are none, or more than this machine has cores.
    """
    most = max(2, os.cpu_count() or 1)
    if not 1 <= processes <= most:
        raise ConfigError(f"--processes is {processes}; expected 1 to {most}, for the cores of this machine.")


def _run(folder: Path, settings: RunSettings) -> None:
    Cache(folder).record(settings)


def run_all(cache: Cache, runs: Sequence[RunSettings], processes: int) -> Iterator[tuple[int, int]]:
    """Run what is not in the cache yet, and yield after each how many of how many unlike runs are there.

    Parameters
    ----------
    cache : Cache
    runs : sequence of RunSettings
    processes : int
        At once; 1 runs them in this one.

    Raises
    ------
    CyclicLoopError
        If a run fails, or a process was ended from outside, for want of memory, say.
    """
    unique = list({json.dumps(asdict(settings), sort_keys=True): settings for settings in runs}.values())
    left = [settings for settings in unique if cache.load(settings) is None]
    done = len(unique) - len(left)
    yield done, len(unique)
    if processes == 1 or len(left) < 2:
        for settings in left:
            _run(cache.folder, settings)
            done += 1
            yield done, len(unique)
        return
    pool = ProcessPoolExecutor(min(processes, len(left)), mp_context=multiprocessing.get_context("spawn"))
    try:
        with uninterrupted():  # on Ctrl-C this process ends the others
            waiting = {pool.submit(_run, cache.folder, settings) for settings in left}
        while waiting:
            ended, waiting = wait(waiting, return_when=FIRST_COMPLETED)
            for future in ended:
                future.result()
                done += 1
            yield done, len(unique)
        pool.shutdown()
    except BrokenProcessPool as error:
        raise CyclicLoopError("a process was ended from outside; run it again, with --processes 1 perhaps.") from error
    finally:
        with uninterrupted():
            pool.shutdown(wait=False, cancel_futures=True)
            for child in multiprocessing.active_children():  # at once, if interrupted; else there are none
                child.terminate()
                child.join()
                for part in cache.folder.glob(f".*.{child.pid}.part.*"):
                    part.unlink(missing_ok=True)
