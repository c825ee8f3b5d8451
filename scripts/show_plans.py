"""Measure floor plans and draw them side by side: cycles, area, tour, walls and perceptual aliasing."""

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
EXAMPLES = """examples:
  python scripts/show_plans.py ring twin_rings generated:cycles=4,seed=7,aliasing=1
  python scripts/show_plans.py generated:validation --out out/validation.png --json out/validation.json

Aliasing is the share of a building's places that look like a place more than 20 m away; the figure marks them."""


class Row(NamedTuple):
    """The measures of a plan, in metres and square metres; the tour is None if the corridors are unknown."""

    plan: str
    cycles: int
    free_area: float
    closed_tour: float | None
    walls: int
    aliasing: float


Measurement = tuple[Row, np.ndarray]
"""The measures of a plan, and its aliased places, `(n, 2)`."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of the command."""

    names: Annotated[tuple[str, ...], Positional, arg(metavar="MAP [MAP ...]", help_behavior_hint="")] = ()
    """shipped plans, generated:..., or files; see maps/README.md"""
    out: OptionalFile = None
    """draw the plans, and mark their aliased places"""
    json: OptionalFile = None
    """write the numbers to a file"""


@command(Options, EXAMPLES)
def main(args: Options) -> None:
    """Run the command."""
    if not args.names:
        raise ConfigError(f"name at least one map; shipped are {', '.join(map_names())}.")
    if args.out:
        from cyclic_env.rendering.figures import check_figure  # before the work, in case matplotlib is missing

        check_figure(args.out)
    check_outputs(filter(None, (args.out, args.json)), map(Path, args.names))
    plans = list(load_floor_plans(args.names))
    measurements: list[Measurement] = []
    with interruptible() as interruption:
        for i, plan in enumerate(plans, 1):
            measurements.append(measured(plan, f"{i} of {len(plans)}, {plan.name}"))
    if measurements:
        write(plans, measurements, args.json, args.out)
    if interruption:
        raise interruption.stopped(f"{len(measurements)} of {len(plans)} plans are measured.")


def write(
    plans: Sequence[FloorPlan], measurements: Sequence[Measurement], json_file: Path | None, figure_file: Path | None
) -> None:
    """Print the table of the measured plans, and write the files that are asked for."""
    rows, aliased = zip(*measurements, strict=True)
    print(table(rows))
    if json_file:
        write_text_atomically(json_file, json.dumps([row._asdict() for row in rows], indent=1) + "\n")
    if figure_file:
        from cyclic_env.rendering.figures import contact_sheet

        figure = contact_sheet(plans[: len(rows)], [caption(row) for row in rows], aliased)
        with atomic_write(figure_file) as part:
            figure.savefig(part, dpi=FIGURE_DPI)


def measured(plan: FloorPlan, title: str) -> Measurement:
    """Measure a plan, and show progress under the title."""
    with compile_notice(), progress_bar(unit="place", desc=title) as progress:

        def show(done: int, total: int) -> None:
            progress.total = total
            progress.update(done - progress.n)

        result = perceptual_aliasing(plan, progress=show)
    tour = plan.closed_tour()
    row = Row(
        plan=plan.name,
        cycles=plan.cycles_total,
        free_area=plan.free_area,
        closed_tour=None if math.isnan(tour) else tour,
        walls=len(plan.walls),
        aliasing=result.share,
    )
    return row, result.positions[result.aliased]


def table(rows: Sequence[Row]) -> str:
    """Format the rows as a table, with the mean aliasing of several plans in the last line."""
    width = max(len("mean"), *(len(row.plan) for row in rows))
    lines = [f"{'plan':<{width}}  cycles  area (m2)  closed tour (m)  walls  aliasing"]
    for row in rows:
        tour = "unknown" if row.closed_tour is None else f"{row.closed_tour:,.0f}"
        sizes = f"{row.cycles:>6}  {row.free_area:>9,.0f}  {tour:>15}  {row.walls:>5,}"
        lines.append(f"{row.plan:<{width}}  {sizes}  {row.aliasing:>8.2f}")
    if len(rows) > 1:
        lines.append(f"{'mean':<{width}}  {np.mean([row.aliasing for row in rows]):>49.2f}")
    return "\n".join(lines)


def caption(row: Row) -> str:
    """Format the caption of a plan in the figure."""
    name = row.plan.replace(",", ", ").replace("generated:", "")
    return f"{name}\ncycles: {row.cycles}, {row.free_area:,.0f} m2, aliasing {row.aliasing:.2f}"
