"""Import a map of ROS' map_server, or a picture, as a floor plan and look at it; or export a plan as such a map."""

from __future__ import annotations

if __name__ == "__main__":
    from _cli import run_script

    run_script(__file__)

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from tyro.conf import Positional, arg

from cyclic_env import CyclicLoopError
from cyclic_env.atomic_write import atomic_write, check_outputs
from cyclic_env.errors import ConfigError
from cyclic_env.floor_plans import (
    FloorPlan,
    OccupancyGrid,
    Tracing,
    load_floor_plan,
    rasterize,
    read_occupancy_grid,
    trace_floor_plan,
    write_floor_plan,
    write_occupancy_grid,
)
from cyclic_env.floor_plans.occupancy.dropped_places import dropped_remark
from cyclic_env.floor_plans.occupancy.grid import UNKNOWN
from cyclic_env.floor_plans.occupancy.map_server import IMAGE_SUFFIXES
from cyclic_env.floor_plans.occupancy.tracing import STAGES
from cyclic_env.floor_plans.strict_yaml import name_of, read_yaml
from cyclic_env.rendering.colors import AMBER, FLOOR, INK, RIGHT, SOLID, WALL
from cyclic_env.validation import short_repr
from scripts._arguments import OptionalFile, OptionalFloat, OptionalFolder
from scripts._cli import command, progress_bar

EXAMPLES = """examples:
  python scripts/import_map.py willow.yaml --out my_plan.yaml --figure my_plan.png
  python scripts/import_map.py drawing.png --resolution 0.02 --start 3.5 2 1.57 --out my_plan.yaml
  python scripts/import_map.py killian_court --export out/maps --resolution 0.05"""

SIZES = ("robot_radius", "speck_area", "gap", "nook_area", "door", "tolerance")
"""Options of `trace_floor_plan`."""
DOUBTFUL_SHARE = 0.25
"""Light grey cells are mentioned if their area exceeds this share of the plan's."""
FIGURE_DPI = 130
EXPORT_RESOLUTION = 0.05


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of the command."""

    input: Annotated[str, Positional, arg(metavar="INPUT")]
    """YAML file of a map, a picture with dark walls, or a floor plan to export"""
    out: OptionalFile = None
    """write the floor plan as YAML"""
    figure: OptionalFile = None
    """draw the map beside the floor plan"""
    export: OptionalFolder = None
    """write the floor plan as a map of map_server"""
    resolution: OptionalFloat = None
    """metres per pixel of a picture, or of --export (default: 0.05)"""
    start: Annotated[tuple[float, float, float] | None, arg(metavar="X Y HEADING", help_behavior_hint="")] = None
    """metres and radians"""
    robot_radius: OptionalFloat = None
    """metres; radius of the robot that must pass (default: 0.25)"""
    speck_area: OptionalFloat = None
    """m2; isolated specks of wall smaller than this are dropped (default: 0.04)"""
    gap: OptionalFloat = None
    """metres; free space narrower than this is closed (default: 0.2)"""
    nook_area: OptionalFloat = None
    """m2; free space that the robot only sees into is kept up to this size (default: 0.5)"""
    door: OptionalFloat = None
    """metres; what was only looked into through openings narrower than this is closed (default: 1.2)"""
    tolerance: OptionalFloat = None
    """metres by which simplified walls may differ from the map (default: 1.5 pixels)"""


@command(Options, EXAMPLES)
def main(args: Options) -> None:
    """Run the command."""
    written = run(args)
    print(f"\nwritten: {', '.join(map(str, written))}" if written else "\nnothing written; give --out, to keep it")


def run(args: Options) -> list[Path]:
    """Import or export as the command line asks, and return the files written.

    Raises
    ------
    CyclicLoopError
        If the input can't be read, or the options don't suit it.
    """
    if args.figure:
        from cyclic_env.rendering.figures import check_figure  # before the work, in case matplotlib is missing

        check_figure(args.figure)
    source = Path(args.input)
    check_outputs(filter(None, (args.out, args.figure)), [source])
    if is_map(args.input):
        plan, grid = import_plan(args)
        image = [] if is_picture(source) else [source.parent / read_yaml(source)["image"]]
    else:
        if not args.export or args.start or sizes(args):
            raise ConfigError(f"{args.input} is a floor plan already: give --export, and with it --resolution at most.")
        plan, grid, image = load_floor_plan(args.input), None, []
        print(table(plan))
    exports = check_export(plan, args, args.export, [source, *image]) if args.export else []
    exported = rasterize(plan, export_resolution(args, grid)) if args.export else None
    if exported is not None:
        share = exported.free.sum() * exported.resolution**2 / plan.free_area
        rows, columns = exported.cells.shape
        print(
            f"{'export':>10}  {columns:,} x {rows:,} pixels of {exported.resolution:g} m, free {share:.1%} of the area"
        )
    if args.out:
        write_floor_plan(plan, args.out)
    if args.figure:
        draw(plan, grid, args.figure)
    if exported is not None:
        write_occupancy_grid(exported, exports[0])
    return [*filter(None, (args.out, args.figure)), *exports]


def import_plan(args: Options) -> tuple[FloorPlan, OccupancyGrid]:
    """Read the map or picture of the command line, trace it, and print the table of the result."""
    source = Path(args.input)
    if args.resolution is not None and not (is_picture(source) or args.export):
        raise ConfigError(f"{source} itself states the size of a pixel; --resolution is for a picture or --export.")
    began = time.perf_counter()
    grid = read_occupancy_grid(source, args.resolution if is_picture(source) else None)
    read = time.perf_counter()
    with progress_bar(len(STAGES), "stage") as progress:

        def show(stage: str) -> None:
            progress.update(STAGES.index(stage) - progress.n)
            progress.set_description(f"tracing: {stage}")

        try:
            tracing = trace_floor_plan(grid, start=args.start, progress=show, **sizes(args))
        except CyclicLoopError as error:
            raise ConfigError(f"{source}: {error}") from error
    plan = tracing.plan
    if not plan.source:
        plan = replace(plan, source=f"traced from {name_of(source)}{source.suffix} by scripts/import_map.py")
    print(table(plan, grid, tracing, read - began, time.perf_counter() - read))
    return plan, grid


def sizes(args: Options) -> dict[str, Any]:
    """Return the sizes given on the command line."""
    return {name: value for name in SIZES if (value := getattr(args, name)) is not None}


def check_export(plan: FloorPlan, args: Options, folder: Path, inputs: Sequence[Path]) -> list[Path]:
    """Return the files to export a plan to, in a folder.

    Raises
    ------
    ConfigError
        If one of them can't be written.
    """
    if Path(plan.name).name != plan.name or not plan.name.isprintable():
        raise ConfigError(
            f"--export: the plan's name {short_repr(plan.name)} is no name of a file; change it in {args.input}."
        )
    exports = [folder / f"{plan.name}{suffix}" for suffix in (".yaml", ".pgm")]
    check_outputs(filter(None, (args.out, args.figure, *exports)), inputs)
    return exports


def export_resolution(args: Options, grid: OccupancyGrid | None) -> float:
    """Return the resolution of an export: the one asked for, or that of the map, or else the default."""
    if args.resolution is not None:
        return args.resolution
    return grid.resolution if grid else EXPORT_RESOLUTION


def is_picture(path: Path) -> bool:
    """Tell whether a file is a picture by its name."""
    return path.suffix.lower() in IMAGE_SUFFIXES


def is_map(name: str) -> bool:
    """Tell whether a name is that of a map or a picture rather than of a floor plan."""
    path = Path(name)
    if is_picture(path):
        return True
    if not path.exists() and not path.suffix:  # the name of a plan
        return False
    data = read_yaml(path)
    if data is None:
        raise ConfigError(f"{path} is an empty file; expected a map with the keys image, resolution and origin.")
    if isinstance(data, Mapping) and not {"image", "exterior", "corridors"} & set(data):
        raise ConfigError(
            f"{path} is neither a map, which has a key `image`, nor a floor plan, which has `exterior` or `corridors`."
        )
    return isinstance(data, Mapping) and "image" in data


def table(
    plan: FloorPlan,
    grid: OccupancyGrid | None = None,
    tracing: Tracing | None = None,
    read_s: float = 0.0,
    traced_s: float = 0.0,
) -> str:
    """Describe a plan, and how it was traced, with one measure on each line."""
    west, south, east, north = plan.bounds
    lengths = ", ".join(f"{hole.exterior.length:,.0f}" for hole in plan.cycles)
    x, y, heading = plan.start
    rows = {"size": f"{east - west:,.1f} m x {north - south:,.1f} m"}
    if grid is not None:
        height, width = grid.cells.shape
        rows["size"] += f", of an image of {width:,} x {height:,} pixels of {grid.resolution:g} m"
    rows |= {
        "free area": f"{plan.free_area:,.0f} m2",
        "cycles": f"{plan.cycles_total}" + (f", of {lengths} m" if lengths else ""),
        "walls": f"{len(plan.walls):,}, pillars among them {len(plan.free_space.interiors) - plan.cycles_total}",
        "start": f"({x:g}, {y:g}), heading {math.degrees(heading):.0f} degrees",
    }
    if tracing is not None:
        rows["dropped"] = (
            f"{tracing.specks:,} specks of {tracing.speck_area:,.1f} m2 in all; {tracing.dropped_area:,.0f} m2 of free "
            "space, out of reach or too narrow"
        )
        rows["time"] = f"read in {read_s:.2f} s, traced in {traced_s:.2f} s"
    if grid is not None:
        rows |= {"look" if i == 0 else " " * i: note for i, note in enumerate(notes(plan, grid, tracing))}
    return "\n".join(f"{name:>10}  {value}" for name, value in rows.items())


def notes(plan: FloorPlan, grid: OccupancyGrid, tracing: Tracing | None) -> list[str]:
    """Say what may be wrong with a plan traced from a grid, and what to do about it."""
    remarks = []
    corners = grid.to_grid(plan.rings[0])
    if corners.min() < 0.5 or (grid.cells.shape[::-1] - corners).min() < 0.5:  # no wall of a cell between
        remarks.append(
            "the plan reaches the image's edge; if that is the paper around a drawing, close the outer doors "
            "with dark lines, or give a --start inside"
        )
    grey = grid.doubtful * grid.resolution**2
    if grey > DOUBTFUL_SHARE * plan.free_area:
        remarks.append(
            f"{grey:,.0f} m2 of light grey are unknown by free_thresh; if they are floor, as in a map of Cartographer, "
            "write 'mode: scale' into the map's YAML"
        )
    if tracing is not None and (dropped := dropped_remark(tracing.dropped, plan.free_area)):
        remarks.append(dropped)
    if not plan.cycles:
        remarks.append(
            "no cycle was found: the robot can drive around nothing in a lap of 40 m or more; if there are loops, "
            "their corridors may be closed by specks, or narrower than the robot (--robot-radius) or a door (--door 0)"
        )
    return remarks


def draw(plan: FloorPlan, grid: OccupancyGrid | None, path: Path) -> None:
    """Draw the plan with its cycles numbered, and to its left the map that it was traced from."""
    from matplotlib.transforms import Affine2D

    from cyclic_env.rendering.figures import add_legend, plan_figure

    cycles = "   ".join(f"cycle {i}: {hole.exterior.length:,.0f} m" for i, hole in enumerate(plan.cycles, 1))
    scores = f"{plan.free_area:,.0f} m2   {len(plan.walls):,} walls   {cycles or 'no cycles'}"
    figure, axes = plan_figure(plan, plan.title or plan.name, scores)
    colors = {name: np.divide(rgb, 255) for name, rgb in (("cycle", RIGHT), ("start", AMBER), ("ink", INK))}
    for i, hole in enumerate(plan.cycles, 1):
        axes.plot(*hole.exterior.xy, color=colors["cycle"], linewidth=1.2, label="cycle" if i == 1 else None)
        place = hole.representative_point()
        label = f"{i}\n{hole.exterior.length:,.0f} m"
        axes.text(place.x, place.y, label, ha="center", va="center", fontsize=8, color=colors["cycle"])
    x, y, heading = plan.start
    axes.plot(x, y, "o", markersize=6, markeredgecolor=colors["ink"], color=colors["start"], label="start")
    ahead = 0.04 * np.ptp(axes.get_xlim()) * np.array([math.cos(heading), math.sin(heading)])
    axes.annotate("", (x + ahead[0], y + ahead[1]), (x, y), arrowprops={"arrowstyle": "->", "color": colors["ink"]})
    add_legend(axes)
    if grid is not None:
        width, height = figure.get_size_inches()
        figure.set_size_inches(2 * width, height)
        place = axes.get_position()
        before = figure.add_axes((place.x0 / 2, place.y0, place.width / 2, place.height))
        axes.set_position((0.5 + place.x0 / 2, place.y0, place.width / 2, place.height))
        before.set(xlim=axes.get_xlim(), ylim=axes.get_ylim(), xticks=[], yticks=[], facecolor=np.divide(SOLID, 255))
        shades = np.array([FLOOR, SOLID, WALL], np.uint8)
        picture = shades[np.where(grid.cells == UNKNOWN, 1, np.where(grid.free, 0, 2))]
        rows, columns = grid.cells.shape
        to_world = Affine2D().scale(grid.resolution).rotate(grid.origin[2]).translate(*grid.origin[:2])
        extent = (0, columns, 0, rows)
        image = before.imshow(picture, origin="lower", extent=extent, transform=to_world + before.transData)
        image.set_clip_path(before.patch)
        before.set(xlim=axes.get_xlim(), ylim=axes.get_ylim())
    with atomic_write(path) as part:
        figure.savefig(part, dpi=FIGURE_DPI)
