"""What the explorer adds to a figure of a run: its groups and its list of open areas. Needs the extra ``plot``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.patheffects import withStroke

from cyclic_env.rendering.colors import AMBER, FAINT, FLOOR, INK, SOLID, WRONG, Color
from cyclic_env.rendering.figures import rgb, write_number

POINTS = 72.0
"""Points per inch."""
DISC = 9.0
"""Diameter of a numbered disc, points; discs that would overlap are moved apart, with lines to their places."""
SPREAD_ROUNDS = 200
LABELS_APART = 16.0
"""Least distance between the names of two groups, points; else the shorter group goes without."""

COMPASS = ("north", "east", "south", "west")
COMPASS_COLORS: tuple[Color, ...] = ((60, 160, 205), (226, 120, 10), (125, 85, 55), (140, 80, 165))
ASIDE = np.array([(1.0, 0.0), (0.0, -1.0), (-1.0, 0.0), (0.0, 1.0)])
"""To the right of each direction, (east, north): its labels go there, so that those of the way back go elsewhere."""
LABEL_AFTER = 0.035
"""Least length of a group with its name beside it, as a share of the building's longer side."""

AREA_STYLES: dict[str, tuple[Color, Color, Color]] = {
    "visited": (INK, INK, FLOOR),
    "reached another way": (FLOOR, FAINT, INK),
    "open": (AMBER, INK, INK),
    "out of reach": (FLOOR, WRONG, WRONG),
}
"""Fill, edge and number of an open area in each state."""


def draw_groups(axes: Axes, groups: Sequence[tuple[str, int, np.ndarray]]) -> None:
    """Draw keyframes as dots in the colour of their group's direction; long groups have their names beside them.

    Parameters
    ----------
    axes : Axes
    groups : sequence of (name, direction, positions)
        Direction 0 to 3: north, east, south, west; positions `(n, 2)` in metres.
    """
    for direction, (word, color) in enumerate(zip(COMPASS, COMPASS_COLORS, strict=True)):
        mine = [positions for _, of, positions in groups if of == direction and len(positions)]
        if mine:
            style = {"linestyle": "", "marker": "o", "markeredgewidth": 0, "color": rgb(color)}
            axes.plot(*np.concatenate(mine).T, markersize=2.2, zorder=3, **style)
            axes.plot([], [], markersize=4, label=f"{word}ward", **style)
    least = LABEL_AFTER * max(np.ptp(axes.get_xlim()), np.ptp(axes.get_ylim()))
    lengths = [np.hypot(*np.ptp(positions, axis=0)) if len(positions) else 0.0 for _, _, positions in groups]
    taken: list[np.ndarray] = []
    for i in sorted(range(len(groups)), key=lambda i: -lengths[i]):
        name, direction, positions = groups[i]
        if lengths[i] < least:
            break
        aside = 13 * ASIDE[direction]
        place = _to_points(axes, positions[len(positions) // 2]) + aside
        if all(np.hypot(*(place - other)) >= LABELS_APART for other in taken):
            taken.append(place)
            middle = positions[len(positions) // 2]
            style = {"ha": "center", "va": "center", "fontsize": 6.5, "color": rgb(COMPASS_COLORS[direction])}
            halo = [withStroke(linewidth=1.5, foreground=rgb(SOLID))]
            axes.annotate(name, middle, aside, textcoords="offset points", zorder=4, path_effects=halo, **style)


def draw_open_areas(axes: Axes, positions: np.ndarray, numbers: Sequence[int], states: Sequence[str]) -> None:
    """Draw open areas as numbered discs, by state.

    Parameters
    ----------
    axes : Axes
    positions : (n, 2)
        Metres.
    numbers : sequence of int
    states : sequence of str
        Each one of `AREA_STYLES`.
    """
    shown = axes.transData.inverted().transform(spread(_to_points(axes, positions), DISC) / POINTS * axes.figure.dpi)
    lines = np.stack([positions, shown], axis=1)
    axes.add_collection(LineCollection(list(lines), colors=[rgb(FAINT)], linewidths=0.6, zorder=4))
    for state, count in sorted(Counter(states).items()):
        fill, edge, ink = AREA_STYLES[state]
        mine = [i for i in range(len(numbers)) if states[i] == state]
        style = {"marker": "o", "markersize": DISC, "markeredgecolor": rgb(edge), "markeredgewidth": 0.8}
        label = f"open area, {'left open' if state == 'open' else state} ({count})"
        axes.plot(*shown[mine].T, linestyle="", color=rgb(fill), label=label, zorder=4.2, **style)
        for i in mine:
            write_number(axes, str(numbers[i]), shown[i], ink, 5.5, 4.4)


def spread(places: np.ndarray, apart: float) -> np.ndarray:
    """Return places `(n, 2)`, moved so far that any two are `apart`, or nearly so in a dense crowd."""
    places = places + 1e-3 * np.arange(len(places))[:, None] * (1.0, 0.0)  # of two at one place the later one is moved
    for _ in range(SPREAD_ROUNDS):
        off = places[:, None] - places[None]
        away = np.hypot(off[..., 0], off[..., 1])
        np.fill_diagonal(away, np.inf)
        short = np.maximum(apart - away, 0.0)
        if not short.any():
            break
        places = places + 0.5 * (off / away[..., None] * short[..., None]).sum(axis=1)
    return places


def _to_points(axes: Axes, positions: np.ndarray) -> np.ndarray:
    """Return positions `(..., 2)` in metres as points on the page."""
    return axes.transData.transform(positions) / axes.figure.dpi * POINTS
