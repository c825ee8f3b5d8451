"""Measure floor plans (cycles, area, tour, walls, aliasing) and draw them side by side."""

from __future__ import annotations

if __name__ == "__main__":
    from _cli import run_script

    run_script(__file__)

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
from tyro.conf import Positional, arg

from cyclic_env import ConfigError, FloorPlan, map_names
from cyclic_env.analysis.perceptual_aliasing import perceptual_aliasing
from cyclic_env.atomic_write import atomic_write, check_outputs, write_text_atomically
from cyclic_env.floor_plans import load_floor_plans
from cyclic_env.jit import compile_notice
from scripts._arguments import OptionalFile
from scripts._cli import command, interruptible, progress_bar

FIGURE_DPI = 150
EPILOG = """examples:
  python scripts/show_plans.py ring twin_rings generated:cycles=4,seed=7,aliasing=1
  python scripts/show_plans.py generated:validation --out out/validation.png --json out/validation.json

Aliasing is the share of a building's places that look like a place more than 20 m away; the figure marks them."""


class PlanStats(NamedTuple):
    """The measurements of a plan. Lengths in m, area in m², aliasing as a share."""

    plan: str
    cycles: int
    free_area: float
    closed_tour: float | None
    """None if the plan's corridors are unknown."""
    walls: int
    aliasing: float


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of the command."""

    # Without a hint, since tyro's would call the empty tuple a default, although a map is required.
    names: Annotated[tuple[str, ...], Positional, arg(metavar="MAP [MAP ...]", help_behavior_hint="")] = ()
    """shipped plans, generated:..., or files; see maps/README.md"""
    out: OptionalFile = None
    """draw the plans to this file, marking aliased places"""
    json: OptionalFile = None
    """write the numbers as JSON to this file"""


@command(Options, EPILOG)
def main(args: Options) -> None:
    """Run the command."""
    if not args.names:
        raise ConfigError(f"name at least one map. Shipped maps: {', '.join(map_names())}.")
    if args.out:
        from cyclic_env.rendering.figures import check_figure  # fail early if matplotlib is missing

        check_figure(args.out)
    # The outputs must not overwrite an input map.
    check_outputs(filter(None, (args.out, args.json)), map(Path, args.names))
    plans = list(load_floor_plans(args.names))
    measured: list[tuple[PlanStats, np.ndarray]] = []
    with interruptible() as interruption:
        for i, plan in enumerate(plans, 1):
            measured.append(measure_plan(plan, f"{i} of {len(plans)}, {plan.name}"))
    if measured:
        stats, aliased = zip(*measured, strict=True)
        report(plans[: len(measured)], stats, aliased, figure_file=args.out, json_file=args.json)
    if interruption:
        raise interruption.stopped(f"measured {len(measured)} of {len(plans)} plans.")


def report(
    plans: Sequence[FloorPlan],
    stats: Sequence[PlanStats],
    aliased: Sequence[np.ndarray],
    *,
    figure_file: Path | None,
    json_file: Path | None,
) -> None:
    """Print the table of the measured plans, and write the files that were asked for."""
    print(table(stats))
    if json_file:
        write_text_atomically(json_file, json.dumps([row._asdict() for row in stats], indent=1) + "\n")
    if figure_file:
        from cyclic_env.rendering.figures import contact_sheet

        figure = contact_sheet(plans, [caption(row) for row in stats], aliased)
        with atomic_write(figure_file) as part:
            figure.savefig(part, dpi=FIGURE_DPI)


def measure_plan(plan: FloorPlan, title: str) -> tuple[PlanStats, np.ndarray]:
    """Measure a plan, showing progress under the title; return its numbers and the aliased places `(n, 2)`."""
    with compile_notice(), progress_bar(unit="place", desc=title) as progress:

        def show(done: int, total: int) -> None:
            progress.total = total
            progress.update(done - progress.n)

        result = perceptual_aliasing(plan, progress=show)
    tour = plan.closed_tour()
    stats = PlanStats(
        plan=plan.name,
        cycles=plan.cycles_total,
        free_area=plan.free_area,
        closed_tour=None if math.isnan(tour) else tour,
        walls=len(plan.walls),
        aliasing=result.share,
    )
    return stats, result.positions[result.aliased]


def table(rows: Sequence[PlanStats]) -> str:
    """Format the rows as a table, with the mean aliasing in the last line if there are several plans."""
    width = max(len("mean"), *(len(row.plan) for row in rows))
    header = f"{'plan':<{width}}  cycles  area (m2)  closed tour (m)  walls  aliasing"
    lines = [header]
    for row in rows:
        tour = "unknown" if row.closed_tour is None else f"{row.closed_tour:,.0f}"
        sizes = f"{row.cycles:>6}  {row.free_area:>9,.0f}  {tour:>15}  {row.walls:>5,}"
        lines.append(f"{row.plan:<{width}}  {sizes}  {row.aliasing:>8.2f}")
    if len(rows) > 1:
        mean = float(np.mean([row.aliasing for row in rows]))
        lines.append(f"{'mean':<{width}}{mean:>{len(header) - width}.2f}")
    return "\n".join(lines)


def caption(row: PlanStats) -> str:
    """Format the caption of a plan in the figure."""
    # A space after each comma makes the settings of a generated plan easier to read.
    name = row.plan.replace(",", ", ").replace("generated:", "")
    return f"{name}\ncycles: {row.cycles}, {row.free_area:,.0f} m2, aliasing {row.aliasing:.2f}"
