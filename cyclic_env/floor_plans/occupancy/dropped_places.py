"""The free space of a map that is not part of its floor plan: how much, where, and how to keep it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import ndimage

from cyclic_env.floor_plans.occupancy.regions import CroppedGrid

AREA_MIN = 1.0
"""Least area of a place that is listed, square metres."""

SHARE = 0.1
"""Least share of the free space that is worth a remark when it is dropped."""

LISTED_MAX = 3

CURES = {
    "glimpse": "only looked into, through an opening narrower than a door; 0 for `door` keeps it",
    "narrow": "behind a passage too narrow for the robot; a smaller `robot_radius` keeps it, or a wider passage",
    "apart": "not connected to the plan; a `start` inside it imports it instead, or open the walls between",
}


class DroppedPlace(NamedTuple):
    """A connected piece of free space that was left out.

    Attributes
    ----------
    area : float
        Square metres.
    position : (x, y)
        A point in it, metres.
    reason : str
        A key of `CURES`.
    """

    area: float
    position: tuple[float, float]
    reason: str


def dropped_places(part: CroppedGrid, space: np.ndarray, glimpses: np.ndarray) -> tuple[DroppedPlace, ...]:
    """Return the larger places of free space outside a plan, largest first, without those at the image's edge.

    Parameters
    ----------
    part : CroppedGrid
    space, glimpses : (rows, columns) bool
        The plan's free space, and the robot's positions in places that were only looked into.
    """
    grid, free, corner = part
    labels, _ = ndimage.label(free & ~space)
    sizes = np.bincount(labels.ravel())
    large = 1 + np.flatnonzero(sizes[1:] >= AREA_MIN / grid.resolution**2)
    rank = np.zeros(len(sizes), np.int32)
    rank[large] = 1 + np.arange(len(large))
    places = []
    for label, (rows, columns) in zip(large, ndimage.find_objects(rank[labels]), strict=True):
        low, high = np.add(corner, (rows.start, columns.start)), np.add(corner, (rows.stop, columns.stop))
        if low.min() <= 0 or (high >= grid.cells.shape).any():
            continue
        around = (slice(rows.start - 1, rows.stop + 1), slice(columns.start - 1, columns.stop + 1))
        inside = labels[around] == label
        row, column = np.argwhere(inside)[sizes[label] // 2] + (rows.start - 0.5, columns.start - 0.5)
        x, y = grid.to_world(np.array([[column + corner[1], row + corner[0]]]))[0]
        if (glimpses[around] & inside).any():
            reason = "glimpse"
        else:
            reason = "narrow" if (ndimage.binary_dilation(inside) & space[around]).any() else "apart"
        places.append(DroppedPlace(sizes[label] * grid.resolution**2, (float(x), float(y)), reason))
    return tuple(sorted(places, key=lambda place: -place.area))


def dropped_remark(places: tuple[DroppedPlace, ...], plan_area: float) -> str:
    """Return a remark on dropped places and how to keep them, or nothing if they are little of the free space."""
    area = sum(place.area for place in places)
    if area <= SHARE * (area + plan_area):
        return ""
    listed = [f"{p.area:,.0f} m2 around ({p.position[0]:.1f}, {p.position[1]:.1f})" for p in places[:LISTED_MAX]]
    cures = [CURES[reason] for reason in dict.fromkeys(place.reason for place in places[:LISTED_MAX])]
    return (
        f"{area:,.0f} m2 of free space, {area / (area + plan_area):.0%} of it, were dropped, such as "
        f"{', '.join(listed)}: {'; or '.join(cures)}"
    )
