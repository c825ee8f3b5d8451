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
ODOMETRY_SHARE = 0.35
"""How far the odometry may widen the page, as a share of the track's longer side."""
POINTS_MAX = 60_000
"""Endpoints are thinned evenly to fewer than twice this many."""


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
        Two lines above the figure.
    plan : FloorPlan or None
    track, odometry : (n, 2)
        Position at each scan, in the plan's frame.
    points : (k, 2) or None
        Endpoints of scans at the track's poses.
    claims : (m,) CLAIM, or None
        The judged claims, whose steps are scans.
    """
    shown = [track] if points is None or not len(points) else [track, np.quantile(points, (0.01, 0.99), axis=0)]
    if plan is not None:
        shown.append(np.reshape(plan.bounds, (2, 2)))
    low, high = np.concatenate(shown).min(axis=0), np.concatenate(shown).max(axis=0)
    beyond = ODOMETRY_SHARE * (high - low).max()
    low = np.minimum(low, np.maximum(odometry.min(axis=0), low - beyond))
    high = np.maximum(high, np.minimum(odometry.max(axis=0), high + beyond))
    (west, south), (east, north) = low.tolist(), high.tolist()
    figure, axes = plan_figure(plan or _open_ground(track[0], low, high), title, scores, (west, south, east, north))
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


def _open_ground(start: np.ndarray, low: np.ndarray, high: np.ndarray) -> FloorPlan:
    """Return a plan without walls within a page from `low` to `high`."""
    beyond = (high - low).max() + 1.0
    (west, south), (east, north) = (low - beyond).tolist(), (high + beyond).tolist()
    page = polygon_from_rings([(west, south), (east, south), (east, north), (west, north)])
    return FloorPlan("open ground", page, (*start.tolist(), 0.0))
