"""Run missing jobs, on all cores or on a cluster, and rerun rows to check that they are reproduced."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from itertools import islice
from typing import Any, Literal, NamedTuple

import numpy as np
from joblib import Parallel, delayed, parallel_config

from cyclic_env.errors import ConfigError
from scripts.comparison.episode import EpisodeLog, run_episode
from scripts.comparison.measures import MEASURES, measures_of
from scripts.comparison.provenance import provenance
from scripts.comparison.suite import Job
from scripts.comparison.table import DONE, FAILED, Row, RunTable
from scripts.comparison.trace import Trace, trace_of

Backend = Literal["loky", "dask", "ray"]

ROUND = 4
"""Runs per worker that a cluster is given at once, since its backends return a batch only as a whole."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunOptions:
    """How jobs are run.

    Parameters
    ----------
    processes : int
        Maximum number of runs in parallel; -1 for all cores, or all workers of the cluster.
    backend : {"loky", "dask", "ray"}
        Backend of joblib: processes on this machine, or a cluster.
    address : str, optional
        Address of the cluster's scheduler.
    time_limit : float
        Seconds after which a run is aborted.
    """

    processes: int = -1
    backend: Backend = "loky"
    address: str | None = None
    time_limit: float = 1800.0


class Result(NamedTuple):
    """A run that has ended: its row, and its trace if that was asked for and there is one."""

    job: Job
    row: Row
    trace: Trace | None


def run_job(job: Job, time_limit: float, keep_trace: bool = False) -> Result:
    """Run a job; if it fails, the row says at which step and why."""
    log, began, trace = EpisodeLog(), time.perf_counter(), None
    row: Row = {**{name: getattr(job, name) for name in Job.__dataclass_fields__}, "privileged": job.privileged}
    try:
        row |= provenance(job)
        run_episode(job, log, time_limit)
        row |= {"status": DONE, **measures_of(log)}
        trace = trace_of(job, log) if keep_trace else None
    except Exception as error:  # an agent may raise anything, and the other runs go on
        reason = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
        row |= {"status": FAILED, "error": f"step {len(log.infos)}: {reason}"}
    row["seconds"] = round(time.perf_counter() - began, 3)
    return Result(job, row, trace)


def run_jobs(jobs: Sequence[Job], traced: Sequence[Job], options: RunOptions) -> Iterator[Result]:
    """Run jobs, and yield each result as it comes.

    Parameters
    ----------
    jobs : sequence of Job
    traced : sequence of Job
        Jobs whose traces are kept.
    options : RunOptions

    Raises
    ------
    ConfigError
        If the cluster's library is missing, or the cluster can't be reached.
    """
    keep = set(traced)
    calls = (delayed(run_job)(job, options.time_limit, job in keep) for job in jobs)
    if options.backend == "loky":
        with parallel_config("loky", n_jobs=options.processes, initializer=_ignore_interrupts):
            results: Any = Parallel(return_as="generator_unordered")(calls)
            yield from results
        return
    with _cluster(options) as workers:
        while batch := list(islice(calls, ROUND * workers)):
            yield from Parallel(n_jobs=options.processes)(batch)  # pyright: ignore[reportReturnType]


def _ignore_interrupts() -> None:
    """Leave Ctrl-C to the parent process, which ends its workers."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _cluster(options: RunOptions) -> AbstractContextManager[int]:
    if options.address is None and options.backend == "dask":
        raise ConfigError("--backend dask needs the --address of the scheduler, such as tcp://host:8786.")
    return _dask(options) if options.backend == "dask" else _ray(options)


@contextmanager
def _dask(options: RunOptions) -> Iterator[int]:
    try:
        from dask.distributed import Client  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ConfigError("--backend dask needs the package: pip install distributed.") from error
    try:
        client = Client(options.address, timeout=30)
    except (OSError, ValueError) as error:
        raise ConfigError(f"there is no Dask scheduler at {options.address}: {error}.") from error
    with client, parallel_config("dask", n_jobs=options.processes):
        yield max(1, sum(client.nthreads().values()))


@contextmanager
def _ray(options: RunOptions) -> Iterator[int]:
    try:
        import ray  # pyright: ignore[reportMissingImports]
        from ray.util.joblib import register_ray  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ConfigError("--backend ray needs the package: pip install ray.") from error
    ray.init(address=options.address)
    register_ray()
    with parallel_config("ray", n_jobs=options.processes):
        yield max(1, int(ray.cluster_resources().get("CPU", 1)))


class Difference(NamedTuple):
    """A value that a rerun did not reproduce."""

    job: Job
    column: str
    before: str
    now: str


def verify(table: RunTable, jobs: Sequence[Job], options: RunOptions) -> list[Difference]:
    """Rerun rows of a table, and return all differences except those in timing.

    Parameters
    ----------
    table : RunTable
    jobs : sequence of Job
        Jobs whose rows are verified.
    options : RunOptions
    """
    differences = []
    for job, row, _ in run_jobs(jobs, (), options):
        now = RunTable.text_of(row)
        before = table.rows[job.key]
        differences += [
            Difference(job, name, before[name], now[name])
            for name in ("status", "error", *MEASURES)
            if before[name] != now[name]
        ]
    return differences


def choose_rows(table: RunTable, jobs: Sequence[Job], count: int) -> list[Job]:
    """Return at most `count` of the jobs that have a row in the table, drawn at random with a fixed seed."""
    there = [job for job in jobs if job in table]
    drawn = np.random.default_rng(0).permutation(len(there))[:count]
    return [there[index] for index in drawn]
