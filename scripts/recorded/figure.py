"""The figure of a run on a robot's log: raw odometry, track, map and claims, over the building."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cyclic_env import FloorPlan
from cyclic_env.atomic_write import atomic_write
from cyclic_env.floor_plans import polygon_from_rings
from cyclic_env.rendering.colors import AMBER, INK
from cyclic_env.rendering.figures import add_legend, draw_claims, draw_path, plan_figure, rgb

DPI = 150
MARGIN = 3.0
"""Metres around all that is drawn."""
ODOMETRY_SHARE = 0.35
"""How far the odometry may widen the page, as a share of the track's longer side."""
POINTS_MAX = 60_000
"""Endpoints that are drawn, at most."""


def draw_recorded_run(
    file: Path,
    title: str,
    scores: str,
    plan: FloorPlan | None,
    track: np.ndarray,
    odometry: np.ndarray,
    points: np.ndarray | None,
    claims: np.ndarray | None,
) -> None:
    """Write the figure of a run.

    Parameters
    ----------
    file : Path
    title, scores : str
        Two lines above.
    plan : FloorPlan or None
    track, odometry : (n, 2)
        Positions by the scans, in the plan's frame.
    points : (k, 2) or None
        Endpoints of scans at the track's poses.
    claims : (m,) CLAIM, or None
        The judged ones, by the scans.
    """
    low, high = track.min(axis=0), track.max(axis=0)
    beyond = MARGIN + ODOMETRY_SHARE * (high - low).max()
    west, south = np.minimum(low, np.maximum(odometry.min(axis=0), low - beyond)) - MARGIN
    east, north = np.maximum(high, np.minimum(odometry.max(axis=0), high + beyond)) + MARGIN
    ground = plan
    if ground is None:  # an empty page of that size
        page = polygon_from_rings([(west, south), (east, south), (east, north), (west, north)])
        ground = FloorPlan("open ground", page, (*track[0].tolist(), 0.0))
    figure, axes = plan_figure(ground, title, scores)
    (x0, x1), (y0, y1) = axes.get_xlim(), axes.get_ylim()
    axes.set(xlim=(min(x0, west), max(x1, east)), ylim=(min(y0, south), max(y1, north)))
    if points is not None:
        drawn = points[:: max(1, len(points) // POINTS_MAX)]
        style = {"s": 0.25, "linewidths": 0, "color": rgb(INK), "alpha": 0.5}
        axes.scatter(*drawn.T, zorder=1.5, rasterized=True, **style)
        axes.plot([], [], linestyle="", marker=".", markersize=3, color=rgb(INK), label="walls, by the closed map")
    axes.plot(*odometry.T, color=rgb(AMBER), linewidth=0.8, zorder=1.8, label="raw odometry")
    steps = np.hypot(*np.diff(track, axis=0).T)
    path = np.column_stack([track, np.append(0.0, np.cumsum(steps))])
    draw_path(axes, path)
    if claims is not None:
        draw_claims(axes, path, claims)
    add_legend(axes)
    with atomic_write(file) as part:
        figure.savefig(part, dpi=DPI)
