"""Measure floor plans, shipped, generated or your own: cycles, area, tour, walls, aliasing; draw them side by side."""

from __future__ import annotations

if __name__ == "__main__":
    from _cli import run_script

    run_script(__file__)

import argparse
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cyclic_env import FloorPlan, map_names
from cyclic_env.analysis.perceptual_aliasing import perceptual_aliasing
from cyclic_env.atomic_write import atomic_write, check_outputs, write_text_atomically
from cyclic_env.floor_plans import load_floor_plans
from cyclic_env.jit import compile_notice
from scripts._cli import command, interruptible, progress_bar

FIGURE_DPI = 150
EXAMPLES = """examples:
  python scripts/show_plans.py ring twin_rings generated:cycles=4,seed=7,aliasing=1
  python scripts/show_plans.py generated:validation --out out/validation.png --json out/validation.json

Aliasing is the share of a building's places that have a look-alike more than 20 m away; the figure marks them."""


class Row(NamedTuple):
    """What is measured of a plan; metres and square metres. The tour is None where its corridors are not known."""

    plan: str
    cycles: int
    free_area: float
    closed_tour: float | None
    walls: int
    aliasing: float


@command
def main(arguments: Sequence[str] | None) -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(
        description=__doc__, epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "names",
        nargs="+",
        metavar="MAP",
        help=f"{', '.join(map_names())}, generated:..., or a file; see maps/README.md",
    )
    parser.add_argument("--out", type=Path, metavar="FILE", help="draw the plans, and mark the places with look-alikes")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the numbers to a file")
    args = parser.parse_args(arguments)
    if args.out:
        from cyclic_env.rendering.figures import check_figure  # before the work: it says what to do without matplotlib

        check_figure(args.out)
    check_outputs(filter(None, (args.out, args.json)), map(Path, args.names))
    plans = list(load_floor_plans(args.names))
    rows: list[Row] = []
    marked: list[np.ndarray] = []
    with interruptible() as interruption:
        for plan in plans:
            row, places = measured(plan, f"{len(rows) + 1} of {len(plans)}, {plan.name}")
            rows.append(row)
            marked.append(places)
    if rows:
        if args.json:
            write_text_atomically(args.json, json.dumps([row._asdict() for row in rows], indent=1) + "\n")
        if args.out:
            from cyclic_env.rendering.figures import contact_sheet

            figure = contact_sheet(plans[: len(rows)], [caption(row) for row in rows], marked)
            with atomic_write(args.out) as part:
                figure.savefig(part, dpi=FIGURE_DPI)
        print(table(rows))
    if interruption:
        raise interruption.stopped(f"{len(rows)} of {len(plans)} plans are measured.")


def measured(plan: FloorPlan, title: str) -> tuple[Row, np.ndarray]:
    """Return the measures of a plan, and its places that have a look-alike, `(n, 2)`."""
    with compile_notice(), progress_bar(unit="place", desc=title) as bar:

        def show(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        looks = perceptual_aliasing(plan, progress=show)
    tour = plan.closed_tour()
    row = Row(
        plan=plan.name,
        cycles=plan.cycles_total,
        free_area=plan.free_area,
        closed_tour=None if math.isnan(tour) else tour,
        walls=len(plan.walls),
        aliasing=looks.share,
    )
    return row, looks.places[looks.alike]


def table(rows: Sequence[Row]) -> str:
    """Return the rows as a table, and the mean aliasing below those of several plans."""
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
    """Return what stands above a plan in the figure."""
    name = row.plan.replace(",", ", ").replace("generated:", "")
    return f"{name}\ncycles: {row.cycles}, {row.free_area:,.0f} m2, aliasing {row.aliasing:.2f}"
