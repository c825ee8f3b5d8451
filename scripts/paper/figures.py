"""The figures of the report, each as PNG and as PDF; the paper's own carry its numbers."""

from __future__ import annotations

import itertools
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator
from PIL import Image

from agents.knn.plotting import draw_groups, draw_open_areas
from agents.knn.similarity import MEASURES
from cyclic_env.atomic_write import atomic_write
from cyclic_env.floor_plans import FloorPlan
from cyclic_env.rendering.figures import add_legend, draw_claims, draw_path, plan_figure
from scripts.paper.recognition import VECTORS
from scripts.paper.runs import BEAM_ROUNDING, RunRecord
from scripts.paper.sections import AGAIN, AGENTS, EXPLORER, SecondLap

DPI = 150
SMALL_WIDTH, SMALL_COLOURS = 1000, 256
"""Pixels, and colours, of the pictures in the documentation."""
COLOURS = dict(
    zip(
        MEASURES,
        ("#7d5537", "#3c82cd", "#1f9e77", "#8c50a5", "#d43d2a", "#e2780a", "#8a8a8a", "#111111"),
        strict=True,
    )
)
MARKERS = dict(zip(MEASURES, "osv^DPX*", strict=True))
AGENT_STYLES: dict[str, dict[str, Any]] = {
    agent: {"color": colour, "linestyle": line, "marker": marker, "markersize": size, "markerfacecolor": "none"}
    for agent, colour, line, marker, size in zip(
        AGENTS, ("#d43d2a", "#111111", "#3c82cd", "#e2780a"), ("-", "-", "--", ":"), "sDo^", (5, 9, 6, 4), strict=True
    )
}
"""Told apart by their markers where colours are not, or lines lie on each other."""
STEPS = (
    "Steps 2 to 4: a change of direction raises the new direction's indicator, and begins a group",
    "Step 1: add a row to the group's table",
    "Step 5: compare with the tables of before",
    "Step 1: add openings to the open areas' list, and strike off those explored",
    "Step 6: go to an open area, or on",
)


def save(figure: Figure, folder: Path, name: str) -> Path:
    """Write a figure into a folder, as PNG and as PDF; return the PNG."""
    picture = folder / f"{name}.png"
    with atomic_write(picture.with_suffix(".pdf")) as part:
        figure.savefig(part, metadata={"CreationDate": None})
    with atomic_write(picture) as part:
        figure.savefig(part, dpi=DPI)
    return picture


def write_small(picture: Path, path: Path) -> Path:
    """Write a picture again, small and of few colours, for the documentation; return the file."""
    with Image.open(picture) as image, atomic_write(path) as part:
        scale = min(1.0, SMALL_WIDTH / image.width)
        size = (round(scale * image.width), round(scale * image.height))
        small = image.convert("RGB").resize(size, Image.Resampling.LANCZOS)
        few = small.quantize(SMALL_COLOURS, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)  # keeps rare colours
        few.save(part, optimize=True)
    return path


def building(plan: FloorPlan) -> Figure:
    """Return Figure 1: the building."""
    title = f"{plan.cycles_total} cycles   {plan.free_area:,.0f} m² of floor   {len(plan.walls):,} walls"
    figure, axes = plan_figure(plan, plan.title or plan.name, title)
    axes.plot(*plan.start[:2], marker="D", linestyle="", color="#111111", markersize=6, label="start")
    add_legend(axes)
    return figure


def algorithm() -> Figure:
    """Return Figure 2: the algorithm, in the order in which the explorer takes the paper's steps."""
    steps = [
        "Sense: laser, distance meter, compass; dead reckoning",
        *STEPS,
        "Drive; claim the place if it is visited",
    ]
    height = 0.85 * len(steps) + 0.25
    figure = Figure((7.5, height))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(0, 7.5), ylim=(0, height))
    axes.set_axis_off()
    left, width, box = 0.9, 5.2, 0.56
    middles = [height - 0.55 - 0.85 * k for k in range(len(steps))]
    for text, y in zip(steps, middles, strict=True):
        style = {"boxstyle": "round,pad=0.02", "facecolor": "#f3efe4", "edgecolor": "#333333", "linewidth": 1.0}
        axes.add_patch(FancyBboxPatch((left, y - box / 2), width, box, **style))
        lines = "\n".join(textwrap.wrap(text, 62))
        axes.text(left + width / 2, y, lines, ha="center", va="center", fontsize=9)
    arrow = {"arrowstyle": "-|>", "color": "#333333", "linewidth": 1.0}
    for upper, lower in itertools.pairwise(middles):
        tail, tip = (left + width / 2, upper - box / 2 - 0.02), (left + width / 2, lower + box / 2 + 0.02)
        axes.annotate("", xy=tip, xytext=tail, arrowprops=arrow)
    back = left + width + 0.35
    axes.plot([left + width + 0.03, back, back], [middles[-1], middles[-1], middles[0]], color="#333333", linewidth=1.0)
    axes.annotate("", xy=(left + width + 0.03, middles[0]), xytext=(back, middles[0]), arrowprops=arrow)
    axes.text(back + 0.12, (middles[0] + middles[-1]) / 2, "next step, until the list is empty", rotation=90, **_MIDDLE)
    above, below = middles[2] + box / 2, middles[-2] - box / 2
    axes.plot([left - 0.1, left - 0.2, left - 0.2, left - 0.1], [above, above, below, below], color="#333333")
    axes.text(left - 0.4, (above + below) / 2, "at a new row, a metre on", rotation=90, **_MIDDLE)
    return figure


_MIDDLE: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": 9, "color": "#333333"}


def start(plan: FloorPlan, record: RunRecord, range_max: float) -> Figure:
    """Return Figure 3: the start, and what the laser sees there."""
    figure, axes = plan_figure(plan, "The start", f"laser of {range_max:g} m, {record.beams.shape[1]} beams")
    x, y, heading = plan.start
    angles = heading + np.arange(record.beams.shape[1]) * 2 * np.pi / record.beams.shape[1]
    ranges = record.beams[0] * BEAM_ROUNDING
    axes.fill(x + ranges * np.cos(angles), y + ranges * np.sin(angles), color="#e2780a", alpha=0.35, label="seen")
    axes.annotate("", xy=(x + 7 * np.cos(heading), y + 7 * np.sin(heading)), xytext=(x, y), arrowprops=_ARROW, zorder=6)
    axes.plot(x, y, marker="D", linestyle="", color="#111111", markersize=6, label="start", zorder=7)
    add_legend(axes)
    return figure


_ARROW: dict[str, Any] = {"arrowstyle": "-|>", "color": "#111111", "linewidth": 1.5}


def similarity_alone(plan: FloorPlan, lap: SecondLap) -> Figure:
    """Return Figure 4: the distances of all points of the first lap, and where they are least."""
    row = lap.points["cosine"]
    figure, axes = plan_figure(
        plan,
        "Similarity alone: all points are compared",
        f"least cosine distance {lap.apart[row]:.4f}, {lap.error(row):.1f} m from where the robot is; "
        "crosses: each measure's least",
    )
    places = lap.record.position[: len(lap.apart)]
    order = np.argsort(-lap.apart)
    shown = axes.scatter(
        *places[order].T, c=lap.apart[order], s=7, cmap="viridis_r", vmax=float(np.quantile(lap.apart, 0.5)), zorder=3
    )
    # In the court, where nothing is drawn.
    bar = figure.colorbar(shown, cax=axes.inset_axes((0.3, 0.87, 0.3, 0.02)), orientation="horizontal", extend="max")
    bar.set_label("cosine distance, up to its median", fontsize=8)
    bar.ax.tick_params(labelsize=7)
    bar.locator = MaxNLocator(4)
    bar.update_ticks()
    _mark(axes, lap, lap.points)
    add_legend(axes)
    return figure


def indicators_and_vote(plan: FloorPlan, lap: SecondLap) -> Figure:
    """Return Figure 5: the tables of one direction that are compared, and the row that the vote finds."""
    row = lap.voted["cosine"]
    record, count = lap.record, len(lap.apart)
    same = np.flatnonzero(record.direction[:count] == record.direction[lap.query])
    figure, axes = plan_figure(
        plan,
        "Indicators, groups and the vote of 4: tables of one direction are compared",
        f"{len(same)} of {count} rows compared; cosine finds a place {lap.error(row):.1f} m from where the robot is",
    )
    others = np.setdiff1d(np.arange(count), same)
    axes.plot(*record.position[others].T, ".", markersize=2, color="#c8c8c8", label="not compared", zorder=2.5)
    axes.plot(*record.position[same].T, ".", markersize=4, color="#3c82cd", label="compared", zorder=3)
    _mark(axes, lap, lap.voted)
    add_legend(axes)
    return figure


def _free_offset(place: np.ndarray, width: float, taken: list[np.ndarray]) -> tuple[float, float]:
    """Return where a label's middle goes, off its place `(2,)`, so that it covers none of the boxes taken; points.

    Boxes are west, south, east and north `(4,)`. If all is taken, the label goes above.
    """
    half = np.array([width / 2, 5.0])
    offsets = list(itertools.product((0.0, half[0] + 4, -half[0] - 4), (13.0, -13.0, 25.0, -25.0, 37.0, -37.0)))
    boxes = [np.concatenate([place + offset - half, place + offset + half]) for offset in offsets]
    free = [all((box[:2] > one[2:]).any() or (box[2:] < one[:2]).any() for one in taken) for box in boxes]
    best = int(np.argmax(free))
    taken.append(boxes[best])
    return offsets[best]


def _mark(axes: Axes, lap: SecondLap, found: Mapping[str, int]) -> None:
    """Mark the query, and what each measure finds; those at one place have one label."""
    position = lap.record.position
    by_row: dict[int, list[str]] = {}
    for name, row in found.items():
        by_row.setdefault(row, []).append(name)
    crosses = axes.transData.transform(position[list(by_row)]) / axes.figure.dpi * 72  # points
    taken = [np.concatenate([cross - 6, cross + 6]) for cross in crosses]
    for (row, names), cross in zip(by_row.items(), crosses, strict=True):
        x, y = position[row]
        colour, label = ("#d43d2a", "found by cosine") if "cosine" in names else ("#8c50a5", None)
        axes.plot(x, y, marker="X", markersize=9, linestyle="", color=colour, label=label, zorder=6)
        text = ", ".join(names)
        offset = _free_offset(cross, 4.4 * len(text), taken)
        halo = [withStroke(linewidth=2, foreground="white")]
        style = {"textcoords": "offset points", "fontsize": 7.5, "color": colour, "path_effects": halo, "zorder": 8}
        axes.annotate(text, (x, y), offset, ha="center", va="center", **style)
    if any("cosine" not in names for names in by_row.values()):
        axes.plot([], [], marker="X", markersize=9, linestyle="", color="#8c50a5", label="by other measures")
    style = {"marker": "D", "markersize": 8, "markerfacecolor": "none", "markeredgewidth": 1.8, "color": "#111111"}
    axes.plot(*position[lap.query], linestyle="", label="the robot", zorder=7, **style)


def finished_run(plan: FloorPlan, record: RunRecord, title: str) -> Figure:
    """Return Figure 6: the finished run with its numbered open areas, and where it stopped."""
    m = record.metrics
    states = m["area_states"]
    counts = [
        f"{states.count(state)} {state}" for state in ("visited", "reached another way", "open") if state in states
    ]
    scores = (
        f"{m['areas']} open areas: {', '.join(counts)}   {m['cycles_closed']} of {m['cycles_total']} cycles closed   "
    )
    scores += f"{m['false_claims']} false claims   {m['path_length_m']:,.0f} m   ended by: {m['ending']}"
    figure, axes = plan_figure(plan, title, scores)
    way = record.way.astype(np.float64)
    draw_path(axes, way)
    groups = [np.flatnonzero(record.group == k) for k in range(m["groups"])]
    named = zip(m["group_names"], groups, strict=True)
    draw_groups(axes, [(name, "NESW".index(name[0]), record.position[rows]) for name, rows in named])
    draw_open_areas(axes, record.areas, list(range(1, m["areas"] + 1)), states)
    draw_claims(axes, way, record.claims)
    add_legend(axes)
    return figure


def recognition_curves(tables: Mapping[str, Sequence[Mapping[str, Any]]]) -> Figure:
    """Return curves of precision over recall of all measures: two vectors, rows as explored and driven again."""
    figure = Figure((10, 8), layout="constrained")
    grid = figure.subplots(2, 2)
    for line, vectors in enumerate(VECTORS):
        for column, test in enumerate((EXPLORER, AGAIN)):
            axes = grid[line, column]
            for entry in tables[test]:
                if entry["vectors"] != vectors or entry["candidates"] not in ("points", "same direction"):
                    continue
                gated = entry["candidates"] == "same direction"
                style = {"color": COLOURS[entry["measure"]], "linestyle": "-" if gated else ":", "linewidth": 1.3}
                if gated:
                    style |= {"marker": MARKERS[entry["measure"]], "markevery": 0.15, "markersize": 4.5}
                label = entry["measure"] if gated else None
                axes.plot(entry["curve"]["recall"], entry["curve"]["precision"], label=label, **style)
            axes.set_title(f"{vectors}, rows {test}", fontsize=10)
            axes.set(xlim=(0, None), ylim=(0, None))
            axes.grid(linewidth=0.3)
    for axes in grid[1]:
        axes.set_xlabel("recall, of rows that return anywhere")
    for axes in grid[:, 0]:
        axes.set_ylabel("precision of the best candidate")
    handles, labels = grid[0, 0].get_legend_handles_labels()
    (dotted,) = grid[0, 0].plot([], [], ":", color="#333333")
    names = [*labels, "dotted: all points"]
    figure.legend([*handles, dotted], names, loc="outside lower center", ncols=5, frameon=False, fontsize=9)
    return figure


GROWTH = {
    "points": {"label": "all points", "color": "#d43d2a", "linestyle": "-"},
    "direction": {"label": "same direction", "color": "#3c82cd", "linestyle": "--"},
    "groups": {"label": "groups first", "color": "#111111", "linestyle": ":"},
}
BINS = 40


def growth(result: Mapping[str, Sequence[float]]) -> Figure:
    """Return what a search costs as the run grows: comparisons, and time."""
    figure = Figure((10, 3.8), layout="constrained")
    axes, times = figure.subplots(1, 2)
    path = np.array(result["path"]) / 1000
    bins = np.linspace(0, path.max(), BINS + 1)
    middle = 0.5 * (bins[1:] + bins[:-1])
    which = np.clip(np.digitize(path, bins) - 1, 0, BINS - 1)
    for name, style in GROWTH.items():
        compared, seconds = np.array(result[name]), np.array(result[f"{name}_s"])
        there = np.unique(which)
        axes.plot(middle[there], [compared[which == k].mean() for k in there], **style)
        times.plot(middle[there], [1e6 * np.median(seconds[which == k]) for k in there], **style)
    axes.set(xlabel="driven, km", ylabel="rows and centres compared for a query", yscale="log")
    times.set(xlabel="driven, km", ylabel="microseconds for a query (median)", ylim=(0, None))
    for each in (axes, times):
        each.grid(linewidth=0.3)
    times.legend(frameon=False, fontsize=9)
    return figure


def noise(entries: Sequence[Mapping[str, Any]]) -> Figure:
    """Return scores over the noise, by agent."""
    figure = Figure((10, 3.6), layout="constrained")
    panels = {"cycles_share": "share of cycles closed", "false_claims": "false claims a run", "recall": "recall"}
    for axes, (key, title) in zip(figure.subplots(1, 3), panels.items(), strict=True):
        for agent, style in AGENT_STYLES.items():
            mine = [entry for entry in entries if entry["agent"] == agent and entry["scale"] is not None]
            scales = [entry["scale"] for entry in mine]
            axes.plot(scales, [entry[key] for entry in mine], label=agent, clip_on=False, zorder=3, **style)
        axes.set(xlabel="noise, as a share of poor", ylabel=title)
        if key == "false_claims":
            axes.set_yscale("symlog", linthresh=1)
        axes.set_ylim(0, None if key == "false_claims" else 1.04)
        axes.grid(linewidth=0.3)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    return figure


def measures(entries: Sequence[Mapping[str, Any]]) -> Figure:
    """Return areas under the curves of all measures, with their intervals."""
    figure = Figure((10, 6.2), layout="constrained")
    grid = figure.subplots(2, 2, sharey=True)
    for line, vectors in enumerate(VECTORS):
        for column, test in enumerate((EXPLORER, AGAIN)):
            axes = grid[line, column]
            mine = [entry for entry in entries if entry["vectors"] == vectors and entry["rows"] == test]
            for k, entry in enumerate(mine):
                span = [[entry["area"] - entry["area_low"]], [entry["area_high"] - entry["area"]]]
                colour = COLOURS[entry["measure"]]
                axes.errorbar(
                    entry["area"], k, xerr=np.maximum(span, 0), fmt=MARKERS[entry["measure"]], color=colour, capsize=3
                )
            axes.set_yticks(range(len(mine)), [entry["measure"] for entry in mine])
            axes.set_title(f"{vectors}, rows {test}", fontsize=10)
            axes.set_xlim(0, None)
            axes.grid(linewidth=0.3)
    for axes in grid[1]:
        axes.set_xlabel("mean area under precision over recall")
    grid[0, 0].invert_yaxis()
    return figure
