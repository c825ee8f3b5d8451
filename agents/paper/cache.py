"""Results kept in small files, so that what was interrupted goes on where it was, and work on several processes."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import signal
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from agents.paper.runs import ARRAYS, RunRecord, RunSettings, run_explorer
from cyclic_env import __version__
from cyclic_env.errors import CyclicLoopError

AGENTS = Path(__file__).resolve().parents[1]
MEASURING = ("knn", "navigation", "paper")
"""Folders whose sources results depend on."""
SHOWING = ("report.py", "figures.py", "reproduction.py")
"""Modules that only show results: a change of theirs leaves results as they are."""


@lru_cache(maxsize=1)
def code_version() -> str:
    """Return the package's version and a hash of the sources that results depend on."""
    digest = hashlib.sha256()
    for folder in MEASURING:
        for file in sorted((AGENTS / folder).iterdir()):
            if file.suffix == ".py" and file.name not in SHOWING:
                digest.update(file.name.encode() + b"\0" + file.read_bytes())
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
            _replace(file, lambda new: new.write_text(json.dumps(result), encoding="utf-8"))
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
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error):
            return None

    def save(self, settings: RunSettings, record: RunRecord) -> None:
        """Keep the record of a run."""
        values = {name: getattr(record, name) for name in ARRAYS} | {"metrics": np.array(json.dumps(record.metrics))}

        def write(new: Path) -> None:
            with new.open("wb") as file:
                np.savez_compressed(file, **values)  # pyright: ignore[reportArgumentType]

        _replace(self._run_file(settings), write)


def _replace(file: Path, write: Callable[[Path], Any]) -> None:
    """Let a file be there as a whole, or not at all."""
    new = file.with_name(f"{file.name}.{os.getpid()}.new")
    try:
        write(new)
        new.replace(file)
    finally:
        new.unlink(missing_ok=True)


def _run(folder: Path, settings: RunSettings) -> None:
    Cache(folder).record(settings)


def _ignore_interrupts() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent sees to it


def run_all(cache: Cache, runs: Sequence[RunSettings], processes: int) -> Iterator[int]:
    """Run what is not in the cache yet, and yield after each how many of all are there.

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
    yield done
    if processes == 1 or len(left) < 2:
        for settings in left:
            _run(cache.folder, settings)
            done += 1
            yield done
        return
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(processes, mp_context=context, initializer=_ignore_interrupts)
    try:
        waiting = {pool.submit(_run, cache.folder, settings) for settings in left}
        while waiting:
            ended, waiting = wait(waiting, return_when=FIRST_COMPLETED)
            for future in ended:
                future.result()
                done += 1
            yield done
        pool.shutdown()
    except BrokenProcessPool as error:
        raise CyclicLoopError("a process was ended from outside; run it again, with --processes 1 perhaps.") from error
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        for child in multiprocessing.active_children():  # at once, if interrupted; else there are none
            child.terminate()
