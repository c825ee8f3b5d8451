"""Figures for papers: a floor plan, and the path and claims of a run in it.

`plan_figure` makes the axes, in metres. Every other function draws one thing into them and adds it to the legend. The
module needs the extra ``plot``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path as FilePath

import numpy as np

from cyclic_env.errors import ConfigError
from cyclic_env.floor_plans import FloorPlan
from cyclic_env.rendering.colors import AMBER, FAINT, FLOOR, INK, PATH_NEW, PATH_OLD, RIGHT, SOLID, WALL, WRONG, Color

try:
    from matplotlib.axes import Axes
    from matplotlib.backend_bases import FigureCanvasBase
    from matplotlib.collections import LineCollection
    from matplotlib.colors import LinearSegmentedColormap
    from matplotlib.figure import Figure
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path
except ImportError as error:
    raise ConfigError('figures need matplotlib, which is missing; pip install "cyclic-loop[plot]".') from error

WIDTH, HEIGHT_MAX = 10.0, 9.0
"""Width of a figure and greatest height of its axes, inches."""
ABOVE, BELOW, LEFT, RIGHT_OF = 0.62, 0.95, 0.55, 0.12
"""Inches around the axes: for the title, the legend, the labels in metres, and an empty margin."""
MARGIN = 0.03
"""Margin around the building, as a share of its longer side."""
LEGEND_COLUMNS_MAX = 6
SHEET_COLUMNS_MAX = 8
SCALE_BAR = 10.0
"""Length of the scale bar below each building of a contact sheet, metres."""
PATH_SPACING = 0.2
"""Metres between the drawn points of a path."""


def check_figure(path: FilePath) -> None:
    """Check that the suffix of a figure's file is a known format.

    Raises
    ------
    ConfigError
        If it is not.
    """
    known = FigureCanvasBase.get_supported_filetypes()
    if path.suffix.lower().removeprefix(".") not in known:
        raise ConfigError(
            f"{path}: a figure's name must end with one of: {', '.join(f'.{name}' for name in sorted(known))}."
        )


def plan_figure(
    plan: FloorPlan, title: str, scores: str = "", bounds: tuple[float, float, float, float] | None = None
) -> tuple[Figure, Axes]:
    """Return a figure of the building or of a part of it, and its axes, in metres.

    Parameters
    ----------
    plan : FloorPlan
    title, scores : str
        Two lines above the building.
    bounds : (west, south, east, north), optional
        The part to show, by default everything.
    """
    west, south, east, north = bounds or plan.bounds
    margin = MARGIN * max(east - west, north - south)
    width, height = east - west + 2 * margin, north - south + 2 * margin
    scale = min((WIDTH - LEFT - RIGHT_OF) / width, HEIGHT_MAX / height)
    total = scale * height + ABOVE + BELOW
    figure = Figure((WIDTH, total))
    left = LEFT + (WIDTH - LEFT - RIGHT_OF - scale * width) / 2
    axes = figure.add_axes((left / WIDTH, BELOW / total, scale * width / WIDTH, scale * height / total))
    axes.set(xlim=(west - margin, east + margin), ylim=(south - margin, north + margin), facecolor=rgb(SOLID))
    axes.tick_params(labelsize=7, colors=rgb(FAINT), length=2.5)
    axes.set_ylabel("metres north", fontsize=7, color=rgb(FAINT))
    axes.set_xlabel("metres east", fontsize=7, color=rgb(FAINT), labelpad=1)
    for spine in axes.spines.values():
        spine.set_edgecolor(rgb(FAINT))
        spine.set_linewidth(0.5)
    draw_building(axes, plan, linewidth=0.7)
    above = {"color": rgb(INK), "va": "center", "parse_math": False}  # so that a dollar sign is just a character
    figure.text(LEFT / WIDTH, 1 - 0.2 / total, title, fontsize=11, fontweight="bold", **above)
    figure.text(LEFT / WIDTH, 1 - 0.42 / total, scores, fontsize=8.5, **above)
    return figure, axes


def contact_sheet(plans: Sequence[FloorPlan], captions: Sequence[str], marked: Sequence[np.ndarray]) -> Figure:
    """Return a figure with small pictures of several buildings, each with a scale bar.

    Parameters
    ----------
    plans : sequence of FloorPlan
    captions : sequence of str
        Text above each building.
    marked : sequence of (n, 2) arrays
        Positions to mark in each, metres.
    """
    columns = min(math.ceil(math.sqrt(len(plans))), SHEET_COLUMNS_MAX)
    rows = math.ceil(len(plans) / columns)
    cell = WIDTH / columns
    figure = Figure((WIDTH, rows * cell), layout="constrained", facecolor=rgb(SOLID))
    for i, (plan, caption, points) in enumerate(zip(plans, captions, marked, strict=True)):
        axes = figure.add_subplot(rows, columns, i + 1)
        axes.set_axis_off()
        axes.set_aspect("equal")
        draw_building(axes, plan, linewidth=0.4)
        axes.scatter(*points.T, s=1.5, color=rgb(AMBER), linewidths=0, zorder=2)
        axes.autoscale_view()
        west, south, *_ = plan.bounds
        axes.plot([west, west + SCALE_BAR], [south - 4, south - 4], color=rgb(INK), linewidth=1.2)
        axes.annotate(f" {SCALE_BAR:g} m", (west + SCALE_BAR, south - 4), fontsize=5, color=rgb(INK), va="center")
        axes.set_title(caption, fontsize=6, color=rgb(INK), parse_math=False)
    return figure


def draw_path(axes: Axes, trajectory: np.ndarray, *, by_time: bool = True) -> None:
    """Draw a path, its start and its end.

    Parameters
    ----------
    axes : Axes
    trajectory : (t + 1, 3)
        x, y and path length, metres, as returned by ``env.trajectory()``.
    by_time : bool
        Whether to draw earlier parts paler.
    """
    points = _thinned(trajectory)[:, :2]
    colors = LinearSegmentedColormap.from_list("time", [rgb(PATH_OLD), rgb(PATH_NEW)])
    pieces = np.stack([points[:-1], points[1:]], axis=1)
    lines = LineCollection(list(pieces), cmap=colors, linewidths=1.3, capstyle="round", zorder=2)
    lines.set_array(np.arange(len(pieces)) if by_time else np.ones(len(pieces)))
    axes.add_collection(lines)
    axes.plot([], [], color=rgb(PATH_NEW), linewidth=1.5, label="path (darker: later)" if by_time else "path")
    start = {"marker": "D", "markersize": 6, "markeredgecolor": rgb(FLOOR), "markeredgewidth": 0.8}
    end = {"marker": "s", "markersize": 12, "fillstyle": "none", "markeredgewidth": 1.2}  # frames any other mark
    for position, style, label in ((points[0], start, "start"), (points[-1], end, "end")):
        axes.plot(*position, linestyle="", color=rgb(INK), label=label, zorder=7, **style)


def draw_claims(axes: Axes, trajectory: np.ndarray, claims: np.ndarray) -> None:
    """Draw judged claims where they were made, with lines to the positions that they name.

    Correct claims are green; those that closed a cycle are larger and numbered. False claims are red crosses.

    Parameters
    ----------
    axes : Axes
    trajectory : (t + 1, 3)
        As returned by ``env.trajectory()``.
    claims : (n,) CLAIM
        As returned by ``env.claims()``.
    """
    made, named = trajectory[claims["step"], :2], trajectory[np.maximum(claims["match"], 0), :2]
    correct, closing = claims["correct"], claims["new_cycle"]
    for kind, color, marker, size, label, zorder in (
        (correct & ~closing, RIGHT, "o", 4.0, "correct claim", 3.6),
        (~correct, WRONG, "X", 6.5, "false claim", 6.0),
        (closing, RIGHT, "o", 10.0, "closes a cycle", 6.2),
    ):
        if not kind.any():
            continue
        linked = kind & (claims["match"] >= 0)
        lines = np.stack([made[linked], named[linked]], axis=1)
        axes.add_collection(LineCollection(list(lines), colors=[rgb(color)], linewidths=1.0, zorder=zorder - 0.2))
        ring = {"marker": "o", "markersize": 2.5, "markerfacecolor": rgb(FLOOR), "markeredgewidth": 0.7}
        axes.plot(*named[linked].T, linestyle="", color=rgb(color), zorder=zorder - 0.1, **ring)
        style = {"marker": marker, "markersize": size, "markeredgecolor": rgb(FLOOR), "markeredgewidth": 0.6}
        label = f"{label} ({np.count_nonzero(kind)})"
        axes.plot(*made[kind].T, linestyle="", color=rgb(color), label=label, zorder=zorder, **style)
    if (claims["match"] >= 0).any():
        line = {"marker": "o", "markersize": 3.0, "markerfacecolor": rgb(FLOOR), "markeredgewidth": 0.7}
        axes.plot([], [], color=rgb(FAINT), linewidth=1.0, label="claim to match", **line)
    for number, position in enumerate(made[closing], 1):
        write_number(axes, str(number), position, FLOOR, 6.5, 6.5)


def add_legend(axes: Axes) -> None:
    """Add a legend of everything drawn so far, below the building."""
    figure = axes.figure
    entries = axes.get_legend_handles_labels()
    rows = math.ceil(len(entries[1]) / LEGEND_COLUMNS_MAX)
    columns = math.ceil(len(entries[1]) / rows)
    figure.legend(*entries, loc="lower center", ncols=columns, fontsize=7.5, frameon=False, labelcolor=rgb(INK))


def _thinned(trajectory: np.ndarray) -> np.ndarray:
    """Return the points of a trajectory at every `PATH_SPACING`, and the last one."""
    passed = np.floor(trajectory[:, 2] / PATH_SPACING)
    return trajectory[np.append(np.flatnonzero(np.diff(passed, prepend=-1.0)), len(trajectory) - 1)]


def write_number(axes: Axes, text: str, position: np.ndarray, color: Color, size: float, zorder: float) -> None:
    """Write a short text centred on a position, metres."""
    axes.text(
        position[0],
        position[1],
        text,
        fontsize=size,
        color=rgb(color),
        ha="center",
        va="center_baseline",
        zorder=zorder,
    )


def draw_building(axes: Axes, plan: FloorPlan, linewidth: float) -> None:
    """Draw a building's floor and walls."""
    rings = [np.vstack([ring, ring[:1]]) for ring in plan.rings]
    outline = Path.make_compound_path(*(Path(ring, closed=True) for ring in rings))
    axes.add_patch(PathPatch(outline, facecolor=rgb(FLOOR), edgecolor=rgb(WALL), linewidth=linewidth, zorder=1))


def rgb(color: Color) -> tuple[float, float, float]:
    """Return a colour in Matplotlib's form, with channels from 0 to 1."""
    red, green, blue = color
    return red / 255, green / 255, blue / 255
