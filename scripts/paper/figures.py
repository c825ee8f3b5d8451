"""The figures of the report. A figure that corresponds to one in the paper has the same number."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch, Polygon
from matplotlib.ticker import MaxNLocator
from PIL import Image

from agents.knn.plotting import COMPASS, draw_groups, draw_open_areas
from agents.knn.similarity import MEASURES
from cyclic_env import CyclicLoopEnv, load_floor_plan
from cyclic_env.atomic_write import atomic_write
from cyclic_env.rendering.figures import add_legend, draw_building, draw_claims, draw_path, plan_figure
from scripts.paper.experiments import EXPLORERS, intervals
from scripts.paper.recognition import BEAMS, SECTORS, SecondLap
from scripts.paper.runs import RunRecord

DPI = 150
SMALL_WIDTH, SMALL_COLORS = 1000, 256
"""Pixels and colours of the pictures in the documentation."""
RED, BLUE, ORANGE, BLACK, PURPLE = "#d43d2a", "#3c82cd", "#e2780a", "#111111", "#8c50a5"
STYLES: dict[str, dict[str, Any]] = {
    explorer: {"color": color, "linestyle": line, "marker": marker, "markersize": 5, "capsize": 2}
    for explorer, color, line, marker in zip(
        EXPLORERS, (BLUE, ORANGE, RED, BLACK), ("--", ":", "-", "-"), "o^sD", strict=True
    )
}


def save(figure: Figure, folder: Path, name: str) -> Path:
    """Write a figure to a folder as PNG and as PDF, and return the path of the PNG."""
    picture = folder / f"{name}.png"
    with atomic_write(picture.with_suffix(".pdf")) as part:
        figure.savefig(part, metadata={"CreationDate": None})
    with atomic_write(picture) as part:
        figure.savefig(part, dpi=DPI)
    return picture


def write_small(picture: Path, path: Path) -> Path:
    """Write a smaller copy of a picture with few colours for the documentation, and return its path."""
    with Image.open(picture) as image, atomic_write(path) as part:
        scale = min(1.0, SMALL_WIDTH / image.width)
        size = (round(scale * image.width), round(scale * image.height))
        small = image.convert("RGB").resize(size, Image.Resampling.LANCZOS)
        few = small.quantize(SMALL_COLORS, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)  # keeps rare colours
        few.save(part, optimize=True)
    return path


def building(record: RunRecord) -> Figure:
    """Return Figure 1: the building."""
    plan = load_floor_plan(record.settings.map)
    sizes = f"{plan.free_area:,.0f} m² of floor (white)   {plan.closed_tour():,.0f} m round trip through every corridor"
    figure, axes = plan_figure(plan, plan.title or plan.name, f"{plan.cycles_total} cycles   {sizes}")
    _mark_start(axes, plan.start)
    add_legend(axes)
    return figure


def _mark_start(axes: Axes, start: Sequence[float], label: str = "start") -> None:
    axes.plot(*start[:2], marker="D", linestyle="", color=BLACK, markersize=6, label=label, zorder=7)


Place = tuple[float, float]


class _Diagram:
    """A flow chart on axes in inches."""

    def __init__(self, width: float, height: float) -> None:
        self.figure = Figure((width, height))
        self.axes = self.figure.add_axes((0, 0, 1, 1))
        self.axes.set(xlim=(0, width), ylim=(0, height))
        self.axes.set_axis_off()

    def box(self, place: Place, text: str, width: float = 2.9, height: float = 0.5) -> None:
        x, y = place
        style: dict[str, Any] = {"boxstyle": "round,pad=0.02", "facecolor": "#f3efe4", "edgecolor": "#333333"}
        self.axes.add_patch(FancyBboxPatch((x - width / 2, y - height / 2), width, height, **style))
        self.axes.text(x, y, text, ha="center", va="center", fontsize=8)

    def question(self, place: Place, text: str, width: float = 3.4, height: float = 0.95) -> None:
        x, y = place
        corners = [(x - width / 2, y), (x, y + height / 2), (x + width / 2, y), (x, y - height / 2)]
        self.axes.add_patch(Polygon(corners, facecolor="#e4ecf5", edgecolor="#333333"))
        self.axes.text(x, y, text, ha="center", va="center", fontsize=8)

    def arrow(self, start: Place, *places: Place, label: str = "", beside: Place = (0.08, 0.1)) -> None:
        style = {"arrowstyle": "-|>", "color": "#333333", "linewidth": 1.0, "shrinkA": 0, "shrinkB": 0}
        corners = [start, *places]
        self.axes.plot(*zip(*corners[:-1], strict=True), color="#333333", linewidth=1.0)
        self.axes.annotate("", xy=corners[-1], xytext=corners[-2], arrowprops=style)
        if label:
            x, y = start
            self.axes.text(x + beside[0], y + beside[1], label, fontsize=8, color="#333333", va="center")


def algorithm() -> Figure:
    """Return Figure 2: the decisions of the preset `paper`, which are the paper's Steps 1 to 6."""
    d = _Diagram(8.9, 8.3)
    left, right = 2.7, 6.8
    row = [8.0, 6.95, 5.85, 4.75, 3.45, 2.3, 1.15]
    west, east, middle = left - 2.25, right + 1.9, (left + right) / 2 + 0.35
    d.box((left, row[0]), "Sense: laser, distance meter, compass", 3.2)
    d.question((left, row[1]), "Steps 2 to 4: has the compass\ndirection changed?")
    d.box((right, row[1]), "The indicator NI, EI, SI or WI grows by 1:\na group begins", 3.3)
    d.box(
        (left, row[2]), "Step 1: a row joins the group, 1 m after the last;\nopenings join the list of open areas", 3.6
    )
    d.question(
        (left, row[3]),
        "Step 5: is it among the group's first 5,\nand an earlier row of this direction\nwithin 2.5 m in X and Y?",
        3.9,
        1.05,
    )
    d.question(
        (left, row[4]), "Do the 4 nearest in appearance\nvote for it, more similar than\nthe threshold?", 3.6, 1.05
    )
    d.box((right, row[4]), "Step 6, visited: claim it, join it to the known\nrow, cancel open areas now reached", 3.4)
    d.question((right, row[5]), "Is the list\nempty?", 2.2)
    d.box((left, row[6]), "Step 6, not visited: go on along the corridor", 3.4)
    d.box((right, row[6]), "Stop", 1.2, 0.4)
    d.box((right, row[3]), "Go to the first open area of the list,\nback along the rows of the groups")
    d.arrow((left, row[0] - 0.25), (left, row[1] + 0.48))
    d.arrow((left + 1.7, row[1]), (right - 1.67, row[1]), label="yes", beside=(0.1, 0.1))
    d.arrow((right, row[1] - 0.25), (right, row[2]), (left + 1.82, row[2]))
    d.arrow((left, row[1] - 0.48), (left, row[2] + 0.25), label="no", beside=(0.08, -0.1))
    d.arrow((left, row[2] - 0.25), (left, row[3] + 0.53))
    d.arrow((left, row[3] - 0.53), (left, row[4] + 0.53), label="yes", beside=(0.16, -0.02))
    d.arrow((left + 1.8, row[4]), (right - 1.72, row[4]), label="yes", beside=(0.1, 0.1))
    d.arrow((left, row[4] - 0.53), (left, row[6] + 0.25), label="no", beside=(0.08, -0.2))
    d.arrow(
        (left - 1.95, row[3]), (west, row[3]), (west, row[6]), (left - 1.72, row[6]), label="no", beside=(-0.2, 0.14)
    )
    d.arrow((right, row[4] - 0.25), (right, row[5] + 0.48))
    d.arrow((left + 1.72, row[6]), (middle, row[6]), (middle, row[5]), (right - 1.1, row[5]))
    d.axes.text(left + 1.78, row[6] + 0.14, "at its end", fontsize=8, color="#333333")
    d.arrow((right, row[5] - 0.48), (right, row[6] + 0.2), label="yes", beside=(0.08, -0.1))
    d.arrow(
        (right + 1.1, row[5]), (east, row[5]), (east, row[3]), (right + 1.47, row[3]), label="no", beside=(0.1, 0.12)
    )
    d.axes.text(left, 0.35, "and sense again, until a corridor ends", ha="center", fontsize=8, style="italic")
    d.axes.text(right, row[3] + 0.36, "and sense again, on the way", ha="center", fontsize=8, style="italic")
    return d.figure


def start(record: RunRecord) -> Figure:
    """Return Figure 3: the start, zoomed in, and what the laser sees there."""
    plan, config = load_floor_plan(record.settings.map), record.settings.config
    x, y, heading = plan.start
    with closing(CyclicLoopEnv(record.settings.map, laser={"range_max": record.settings.range_max})) as env:
        ranges = env.reset(seed=record.settings.seed)[0]["laser"]
    figure, axes = plan_figure(
        plan,
        "The start",
        f"laser: {len(ranges)} beams, {config.range_max:g} m; numbers: the least range in each of the "
        f"{config.sectors} sectors, rounded to {config.rounding:g} m",
        (x - 8.0, y - 4.0, x + 8.0, y + 4.0),
    )
    angles = heading + np.arange(len(ranges)) * 2 * np.pi / len(ranges)
    axes.fill(x + ranges * np.cos(angles), y + ranges * np.sin(angles), color=ORANGE, alpha=0.3, label="seen")
    bearings = heading + np.linspace(-np.pi / 2, np.pi / 2, config.sectors)
    half = np.pi / (2 * (config.sectors - 1))
    for bearing, value in zip(bearings, record.features[0, 0] * config.rounding, strict=True):
        arc = np.linspace(bearing - half, bearing + half, 20)
        rim = np.column_stack([x + value * np.cos(arc), y + value * np.sin(arc)])
        axes.plot(*np.vstack([(x, y), rim, (x, y)]).T, color=PURPLE, linewidth=0.9, zorder=5)
        away = value + 0.35
        text = {"ha": "center", "va": "center", "fontsize": 8, "color": PURPLE, "zorder": 6}
        axes.text(x + away * np.cos(bearing), y + away * np.sin(bearing), f"{value:g}", **text)
    axes.plot([], [], color=PURPLE, linewidth=0.9, label="sectors")
    tip = (x + 2.5 * np.cos(heading), y + 2.5 * np.sin(heading))
    arrow = {"arrowstyle": "-|>", "color": BLACK, "linewidth": 1.5}
    axes.annotate("", xy=tip, xytext=(x, y), arrowprops=arrow, zorder=6)
    _mark_start(axes, plan.start, "start, and heading")
    add_legend(axes)
    return figure


def similarity_alone(lap: SecondLap) -> Figure:
    """Return Figure 4: the cosine distance of all points of the first lap from the query, and the least one."""
    distances = lap.distances(MEASURES["cosine"], SECTORS)
    query, found = _near_start(lap, distances, "points")
    record, apart = lap.record, distances[query]
    places = record.position[: lap.rows]
    error = np.hypot(*(places[found] - record.position[lap.rows + query]))
    figure, axes = plan_figure(
        load_floor_plan(record.settings.map),
        "Similarity alone: all points are compared (7 sectors, ideal sensors)",
        f"the point with the least cosine distance, {apart[found]:.4f}, lies {error:.1f} m from the robot",
    )
    order = np.argsort(-apart)
    points = axes.scatter(
        *places[order].T, c=apart[order], s=7, cmap="viridis_r", vmax=float(np.quantile(apart, 0.5)), zorder=3
    )
    bar = figure.colorbar(points, cax=axes.inset_axes((0.3, 0.87, 0.3, 0.02)), orientation="horizontal", extend="max")
    bar.set_label("cosine distance (no unit); all above the median in one color", fontsize=8)
    bar.ax.tick_params(labelsize=7)
    bar.locator = MaxNLocator(4)
    bar.update_ticks()
    _mark_answer(axes, lap, query, found)
    axes.plot(*zip(places[found], record.position[lap.rows + query], strict=True), color=RED, linewidth=0.8, zorder=5)
    add_legend(axes)
    return figure


def indicators_and_position(lap: SecondLap) -> Figure:
    """Return Figure 5: the rows that direction and position leave to compare, and the one that the vote finds."""
    distances = lap.distances(MEASURES["cosine"], SECTORS)
    query, found = _near_start(lap, distances, "direction, vote, position")
    record, n = lap.record, lap.rows
    direction = lap.candidates("direction, vote")[query]
    near = lap.candidates("direction, vote, position")[query]
    name = COMPASS[record.direction[n + query]]
    error = np.hypot(*(record.position[found] - record.position[n + query]))
    figure, axes = plan_figure(
        load_floor_plan(record.settings.map),
        "Indicators, groups, KNN and position (7 sectors, ideal sensors)",
        f"{direction.sum()} of {n} rows were taken {name}ward, {near.sum()} of these near; found: {error:.1f} m away",
    )
    inset = axes.inset_axes((0.25, 0.6, 0.27, 0.33))
    x, y = record.position[n + query]
    inset.set(xlim=(x - 6, x + 6), ylim=(y - 6, y + 6), xticks=[], yticks=[], aspect="equal")
    inset.set_facecolor(axes.get_facecolor())
    draw_building(inset, load_floor_plan(record.settings.map), linewidth=0.7)
    style: dict[str, Any] = {"linestyle": "", "marker": "."}
    for each, scale in ((axes, 1.0), (inset, 2.0)):
        each.plot(
            *record.position[:n][~direction].T,
            markersize=3 * scale,
            color="#a8a8a8",
            label="another direction",
            **style,
        )
        each.plot(
            *record.position[:n][direction].T, markersize=4 * scale, color=BLUE, label=f"{name}ward rows", **style
        )
        each.plot(*record.position[:n][near].T, markersize=7 * scale, color=ORANGE, label="those within 2.5 m", **style)
    _mark_answer(inset, lap, query, found)
    axes.indicate_inset_zoom(inset, edgecolor=BLACK)
    _mark_answer(axes, lap, query, found)
    add_legend(axes)
    return figure


def _near_start(lap: SecondLap, distances: np.ndarray, search: str) -> tuple[int, int]:
    """Return the query a metre after the start of the second lap, and its answer."""
    return 1, int(lap.answers(distances, search)[0][1])


def _mark_answer(axes: Axes, lap: SecondLap, query: int, found: int) -> None:
    axes.plot(*lap.record.position[found], marker="X", markersize=9, linestyle="", color=RED, label="found", zorder=6)
    x, y = lap.record.position[lap.rows + query]
    axes.scatter(x, y, 64, marker="D", facecolors="none", edgecolors=BLACK, linewidths=1.8, label="the robot", zorder=7)


def finished_run(record: RunRecord) -> Figure:
    """Return Figure 6: the finished run with its numbered open areas, and where it stopped."""
    m, plan = record.metrics, load_floor_plan(record.settings.map)
    states = m["area_states"]
    counts = [f"{states.count(state)} {state}" for state in dict.fromkeys(states)]
    scores = (
        f"open areas: {', '.join(counts)}   {m['cycles_closed']} of {m['cycles_total']} cycles closed   "
        f"{m['false_claims']} false claims   {m['path_length_m']:,.0f} m   ended by: {m['ending']}"
    )
    figure, axes = plan_figure(plan, f"The finished run of the preset {record.settings.preset}", scores)
    draw_path(axes, record.trajectory, by_time=False)
    groups = [np.flatnonzero(record.group == k) for k in range(len(m["group_names"]))]
    named = zip(m["group_names"], groups, strict=True)
    draw_groups(axes, [(name, "NESW".index(name[0]), record.position[rows]) for name, rows in named])
    draw_open_areas(axes, record.areas, list(range(1, len(states) + 1)), states)
    draw_claims(axes, record.trajectory, record.claims)
    add_legend(axes)
    return figure


def growth(frame: pd.DataFrame) -> Figure:
    """Return the figure of the cost of a search as the run grows: comparisons, and median time."""
    figure = Figure((10, 3.8), layout="constrained")
    axes, times = figure.subplots(1, 2)
    bins = pd.cut(frame.path_m / 1000, 40)
    binned = frame.groupby(bins, observed=True)
    kilometres = binned.path_m.mean() / 1000
    labels = {"points": "all points", "direction": "earlier groups of the direction", "groups": "their centres"}
    for (name, label), color, line in zip(labels.items(), (RED, BLUE, BLACK), ("-", "--", ":"), strict=True):
        axes.plot(kilometres, binned[name].mean(), color=color, linestyle=line, label=label)
        times.plot(kilometres, 1e6 * binned[f"{name}_s"].median(), color=color, linestyle=line)
    axes.set(xlabel="driven, km", ylabel="vectors compared with one query", yscale="log")
    times.set(xlabel="driven, km", ylabel="microseconds of one query (median)", ylim=(0, None))
    for each in (axes, times):
        each.grid(linewidth=0.3)
    axes.legend(frameon=False, fontsize=9)
    return figure


def noise(frame: pd.DataFrame) -> Figure:
    """Return the figure of each explorer's scores over the scale of the noise, with 95 % intervals over plans."""
    figure = Figure((10, 3.6), layout="constrained")
    panels = {"cycles_share": "share of cycles closed", "false_claims": "false claims a run", "success": "success"}
    for axes, (metric, title) in zip(figure.subplots(1, 3), panels.items(), strict=True):
        entries = intervals(frame, ("explorer", "scale"), metric).fillna({"low": np.nan, "high": np.nan})
        for offset, (explorer, style) in zip((-0.012, -0.004, 0.004, 0.012), STYLES.items(), strict=True):
            mine = entries.loc[explorer]
            low, high = mine.low.fillna(mine["mean"]).clip(0), mine.high.fillna(mine["mean"])
            if metric != "false_claims":
                high = high.clip(upper=1)
            span = np.maximum([mine["mean"] - low, high - mine["mean"]], 0)
            axes.errorbar(mine.index + offset, mine["mean"], span, label=explorer, elinewidth=0.8, **style)
        axes.set(xlabel="noise, as a share of `poor`", ylabel=title)
        if metric == "false_claims":
            axes.set_yscale("symlog", linthresh=1)
        axes.set_ylim(0, None if metric == "false_claims" else 1.04)
        axes.grid(linewidth=0.3)
    handles, names = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    return figure


def measures(frame: pd.DataFrame) -> Figure:
    """Return the average precision of each measure, with 95 % intervals over plans, for both kinds of vectors."""
    figure = Figure((10, 3.4), layout="constrained")
    for axes, vectors in zip(figure.subplots(1, 2, sharey=True), (SECTORS, BEAMS), strict=True):
        mine = frame.query("vectors == @vectors and search == 'direction' and noise == 'calibrated'")
        entries = intervals(mine, ("measure",), "average_precision").loc[list(MEASURES)[::-1]]
        low, high = entries.low.fillna(entries["mean"]), entries.high.fillna(entries["mean"])
        span = np.maximum([entries["mean"] - low.clip(0), high.clip(upper=1) - entries["mean"]], 0)
        axes.errorbar(entries["mean"], range(len(entries)), xerr=span, fmt="o", color=BLUE, capsize=3)
        axes.set_yticks(range(len(entries)), [measure.capitalize() for measure in entries.index])
        axes.set(title=f"{vectors}, calibrated sensors", xlim=(-0.02, 1))
        axes.set_xlabel(f"average precision, mean over {frame['map'].nunique()} plans with 95 % interval")
        axes.grid(linewidth=0.3)
    return figure
