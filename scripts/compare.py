"""Compare agents: the same starts and noise for all, a table that grows, statistics, figures, and a page of replays."""

from __future__ import annotations

if __name__ == "__main__":
    from _cli import run_script

    run_script(__file__)

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from agents import agent_names
from agents.comparison import load_contestant
from cyclic_env.errors import ConfigError
from cyclic_env.floor_plans import separate_names
from cyclic_env.tiers import TIERS
from cyclic_env.validation import check_choice
from scripts._arguments import Flag, OptionalInt, OptionalText
from scripts._cli import command, interruptible, progress_bar
from scripts.comparison.provenance import provenance
from scripts.comparison.report import write_report
from scripts.comparison.runner import Backend, RunOptions, choose_rows, run_jobs, verify
from scripts.comparison.suite import SUITES, Job, Suite, jobs_of
from scripts.comparison.table import FAILED, RunTable
from scripts.comparison.trace import trace_path, write_trace

EXAMPLES = f"""agents by name: {", ".join(agent_names())}
tiers: {", ".join(TIERS)}

examples:
  python scripts/compare.py --agents knn,frontier,oracle --maps ring,figure_eight --noise calibrated,hard --seeds 3
  python scripts/compare.py --agents out/ppo_ring,my_module:make_my_agent --maps generated:validation,index=0
  python scripts/compare.py                    # the default suite, an hour on two cores
  python scripts/compare.py --suite report     # the report, days; goes on where it was
  python scripts/compare.py --verify 20        # run 20 rows again, and say what differs
  python scripts/compare.py --backend dask --address tcp://host:8786

All agents get the same starts and noise. What is in the table is not run again; a new agent is added to it."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of the command."""

    agents: OptionalText = None
    """names, files of models, or module:function, with commas between (default: those of the suite)"""
    maps: OptionalText = None
    """floor plans with commas between; a split stands for all of its buildings (default: those of the suite)"""
    noise: OptionalText = None
    """tiers with commas between; hard also has another laser (default: those of the suite)"""
    seeds: OptionalInt = None
    """how many, from 0 (default: as many as in the suite)"""
    suite: str = "default"
    """default or report"""
    plan_start: Flag = False
    """begin at the plan's own start (default: where the seed draws it)"""
    out: Annotated[Path, arg(metavar="DIR", help_behavior_hint="(default: out/compare)")] = Path("out/compare")
    """folder of the table, the traces and the report"""
    processes: int = -1
    """most runs at once; -1 for all cores, or all workers of a cluster"""
    backend: Backend = "loky"
    """processes on this machine, or a cluster"""
    address: OptionalText = None
    """of the cluster's scheduler"""
    time_limit: float = 1800.0
    """seconds after which a run is given up"""
    renew: Flag = False
    """run again what failed, and what was made by other code"""
    verify: OptionalInt = None
    """run so many rows again, and say what differs, instead"""
    no_report: Flag = False
    """run, and write no report"""
    report_only: Flag = False
    """run nothing, and write the report of what is there"""


@command(Options, EXAMPLES)
def main(args: Options) -> int:
    """Run the command."""
    suite, jobs = chosen(args)
    args.out.mkdir(parents=True, exist_ok=True)
    table = RunTable(args.out / "runs.csv")
    if table.damaged:
        print(f"{table.path}: {table.damaged} damaged lines; their runs are run again, the old file is kept beside it.")
    options = RunOptions(
        processes=args.processes, backend=args.backend, address=args.address, time_limit=args.time_limit
    )
    if args.verify is not None:
        return verify_rows(table, choose_rows(table, jobs, args.verify), options)
    if not args.report_only:
        run_missing(table, jobs, args, options)
    for row in (table.rows[job.key] for job in jobs if job in table):
        if row["status"] == FAILED:
            print("failed: {agent} on {map}, {tier}, seed {seed}: {error}".format(**row))
    if not args.no_report:
        for path in write_report(table, jobs, suite, replayed(jobs), args.out):
            print(path)
    return 0


def chosen(args: Options) -> tuple[Suite, list[Job]]:
    """Return what the command line asks for.

    Raises
    ------
    CyclicLoopError
        If it asks for what can't be: unknown agents, maps or tiers, or a number that isn't one.
    """
    base = SUITES[check_choice("suite", args.suite, SUITES)]
    if not (args.time_limit > 0 and math.isfinite(args.time_limit)):
        raise ConfigError(f"--time-limit is {args.time_limit:g}; expected seconds, more than 0.")
    if args.processes == 0 or args.processes < -1:
        raise ConfigError(f"--processes is {args.processes}; expected -1, or at least 1.")
    suite = Suite(
        agents=base.agents if args.agents is None else tuple(args.agents.split(",")),
        maps=base.maps if args.maps is None else tuple(separate_names(args.maps)),
        tiers=base.tiers if args.noise is None else tuple(args.noise.split(",")),
        seeds=base.seeds if args.seeds is None else args.seeds,
    )
    jobs = jobs_of(suite, start="plan" if args.plan_start else "random")
    for agent in suite.agents:
        load_contestant(agent, map_name=jobs[0].map)
    return suite, jobs


def run_missing(table: RunTable, jobs: Sequence[Job], args: Options, options: RunOptions) -> None:
    """Run what the table doesn't have, and keep each row as it comes.

    Raises
    ------
    Stopped
        If the command is interrupted; all that had ended is kept.
    """
    traced = replayed(jobs)
    stale = [job for job in jobs if job in table and table.stale(job, provenance(job))]
    failed = [job for job in jobs if job in table and table.rows[job.key]["status"] == FAILED]
    if stale and not args.renew:
        print(f"{len(stale)} rows were made by other code or on other plans and are kept; --renew runs them again.")
    again = {*stale, *failed} if args.renew else set()
    untraced = {job for job in traced if not trace_path(args.out, job).exists() and job not in failed}
    left = [job for job in jobs if job not in table or job in again or job in untraced]
    with (
        interruptible() as interruption,
        progress_bar(total=len(jobs), unit="run", initial=len(jobs) - len(left)) as progress,
    ):
        for job, row, trace in run_jobs(left, traced, options):
            table.add(row)
            if trace is not None:
                write_trace(args.out, job, trace)
            progress.update()
    if left:
        table.tidy()
    if interruption:
        raise interruption.stopped(f"{len(table.rows)} runs are in {table.path}; the same command goes on.")


def replayed(jobs: Sequence[Job]) -> list[Job]:
    """Return the jobs that the page replays: each agent's first one on the most interesting map, in each tier."""
    maps = {job.map for job in jobs}
    stage = "killian_court" if "killian_court" in maps else jobs[0].map
    return [job for job in jobs if job.map == stage and job.seed == 0]


def verify_rows(table: RunTable, jobs: Sequence[Job], options: RunOptions) -> int:
    """Run rows again, print what differs, and return the exit code.

    Raises
    ------
    ConfigError
        If there are none.
    """
    if not jobs:
        raise ConfigError(f"{table.path} has no rows of these runs to verify.")
    differences = verify(table, jobs, options)
    for job, column, before, now in differences:
        print(f"{job.agent} on {job.map}, {job.tier}, seed {job.seed}: {column} was {before or '-'}, is {now or '-'}")
    wrong = len({difference.job for difference in differences})
    print(f"{len(jobs)} rows run again: {len(jobs) - wrong} are the same, {wrong} differ.")
    stale = [job for job in jobs if table.stale(job, provenance(job))]
    if stale:
        print(f"{len(stale)} of them were made by other code or on other plans.")
    return int(wrong > 0)
