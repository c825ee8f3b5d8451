"""The cells of a grid that a robot's centre can reach, without specks and places that were only looked into.

Lengths and areas are in cells unless stated otherwise.
"""

from __future__ import annotations

import math
from collections import defaultdict
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from scipy import ndimage

from cyclic_env.errors import FloorPlanError
from cyclic_env.floor_plans.floor_plan import Pose
from cyclic_env.floor_plans.occupancy.grid import FREE_BELOW, UNKNOWN, OccupancyGrid
from cyclic_env.floor_plans.occupancy.morphology import dilated

ENCLOSED_SHARE = 0.1
"""A region with at least this share of the largest one's area is preferred to it if only the largest is cut by the
image's edge, like the paper around a drawing, or if it lies in the largest, like a drawing in a frame, and has more
walls."""

BOUNDED_SHARE = 0.25
"""Least share of walls in the outline of a place that was only looked into to be a room rather than a yard."""

LONE_SHARE = 0.25
"""Least size of a single group that may separate two places, as a share of the greatest size of a speck."""

NEAR = 2.5
"""A wall this close to the border of the space that was seen bounds it. Unknown space is more than twice as wide, since
thinner grey is the edge of a line."""

FITS_NOWHERE = "the robot fits nowhere in the map's free space; is the resolution right, or its radius too large?"

CONNECTED_8 = np.ones((3, 3), dtype=int)


class CroppedGrid(NamedTuple):
    """The part of a grid that has free cells, with a rim of walls.

    Attributes
    ----------
    grid : OccupancyGrid
    free : (rows, columns) bool
        The free cells of the part.
    corner : (int, int)
        Row and column of the part's first cell in the grid; -1 for a rim outside the grid.
    """

    grid: OccupancyGrid
    free: np.ndarray
    corner: tuple[int, int]

    def cell(self, pose: Pose) -> tuple[int, int]:
        """Return the row and column, in the part, of the cell that a pose in the world is in."""
        column, row = np.floor(self.grid.to_grid(np.array([pose[:2]]))[0]).astype(int) - self.corner[::-1]
        return int(row), int(column)

    def has(self, row: int, column: int) -> bool:
        """Tell whether the part has a cell."""
        return 0 <= row < self.free.shape[0] and 0 <= column < self.free.shape[1]


def crop(grid: OccupancyGrid) -> CroppedGrid:
    """Crop a grid to its free cells, which must exist."""
    free = grid.free
    row, column = (np.flatnonzero(free.any(axis=axis))[[0, -1]] for axis in (1, 0))
    part = free[row[0] : row[1] + 1, column[0] : column[1] + 1]
    return CroppedGrid(grid, np.pad(part, 1), (int(row[0]) - 1, int(column[0]) - 1))


def drop_specks(free: np.ndarray, cells_min: float, radius: float) -> tuple[int, int]:
    """Free the groups of fewer than `cells_min` wall cells, in place; return the number of groups and of cells.

    Cells of a group are at most one other cell apart, so that a wall that the laser saw as a row of dots is one group.
    Groups that separate two places for a robot of that radius stay, like the posts of windows, except for a very small
    single group, like noise in a doorway.
    """
    walls = ~free
    groups = ndimage.label(dilated(walls, 1.5), CONNECTED_8)[0]
    groups[free] = 0
    sizes = np.bincount(groups.ravel())
    small = sizes < cells_min
    small[[0, groups[0, 0]]] = False  # no wall, and the rim
    regions = ndimage.label(~dilated(walls, radius))[0]
    margin = math.ceil(radius) + 1
    posts = defaultdict(list)
    for group, box in enumerate(ndimage.find_objects(groups), 1):
        if small[group]:
            around = tuple(slice(max(part.start - margin, 0), part.stop + margin) for part in box)
            for pair in combinations(np.unique(regions[around][regions[around] > 0]), 2):
                posts[pair].append(group)
    for together in posts.values():
        if len(together) > 1 or sizes[together[0]] >= LONE_SHARE * cells_min:
            small[together] = False
    free |= small[groups]
    return int(np.count_nonzero(small)), int(sizes[small].sum())


def reachable_centres(part: CroppedGrid, radius: float, start: Pose | None) -> np.ndarray:
    """Return the cells that the centre of a robot can reach from the start, or the largest region of such cells.

    Raises
    ------
    FloorPlanError
        If the robot fits nowhere, or not at the start.
    """
    grid, free, corner = part
    open_space = ~dilated(~free, radius)
    labels = ndimage.label(open_space)[0]
    sizes = np.bincount(labels.ravel())[1:]
    if not len(sizes):
        raise FloorPlanError(FITS_NOWHERE)
    if start is None:
        rows, columns = (low + np.arange(size) for low, size in zip(corner, free.shape, strict=True))
        cut = np.zeros(len(sizes) + 1, bool)
        cut[labels[(rows < radius + 1) | (rows > grid.cells.shape[0] - radius - 2)]] = True
        cut[labels[:, (columns < radius + 1) | (columns > grid.cells.shape[1] - radius - 2)]] = True
        row, column = part.cell((0.0, 0.0, 0.0))
        origin = int(labels[row, column]) if part.has(row, column) else 0
        origin *= not cut[origin]
        return labels == _building(labels, np.where(cut[1:], ENCLOSED_SHARE, 1.0) * sizes, origin)
    row, column = part.cell(start)
    inside = part.has(row, column)
    if inside and open_space[row, column]:
        return labels == labels[row, column]
    rows, columns = np.nonzero(open_space)
    nearest = np.argmin((rows - row) ** 2 + (columns - column) ** 2)
    x, y = grid.to_world(np.array([[columns[nearest] + corner[1] + 0.5, rows[nearest] + corner[0] + 0.5]]))[0]
    fault = "too near a wall" if inside and free[row, column] else "in a wall, in unknown space or outside the map"
    raise FloorPlanError(f"start ({start[0]:g}, {start[1]:g}) is {fault}; move it, for example to ({x:.2f}, {y:.2f}).")


def _building(labels: np.ndarray, sizes: np.ndarray, origin: int) -> int:
    """Return the label of the largest region, or of a better one that has more walls and is not far smaller.

    A better one lies inside it: a building has more walls than the paper around it in the frame of a drawing, but also
    more than a courtyard inside it. Or it has the label `origin`, at the origin of the world, like a race track, where
    mapping began and which has more walls than the infield.
    """
    edge = labels[(labels > 0) & ~ndimage.binary_erosion(labels > 0)]
    walls = np.bincount(edge, minlength=len(sizes) + 1)[1:]
    best = int(np.argmax(sizes))
    while True:
        rivals = (walls > walls[best]) & (sizes >= ENCLOSED_SHARE * sizes[best])
        if not rivals.any():
            return 1 + best
        if origin and rivals[origin - 1]:
            return origin
        part = labels[ndimage.find_objects(labels, 1 + best)[best]]
        enclosed = np.unique(part[ndimage.binary_fill_holes(part == 1 + best)])
        rivals &= np.isin(np.arange(1, len(sizes) + 1), enclosed)
        if not rivals.any():
            return 1 + best
        best = int(np.argmax(np.where(rivals, sizes, 0)))


def drop_glimpses(centres: np.ndarray, part: CroppedGrid, radius: float, door: float, start: Pose | None) -> np.ndarray:
    """Return the centres without the places that were only looked into, behind openings narrower than a door.

    A place is a glimpse, only looked into, if more of its outline is unknown than wall. It stays if it is on the way to
    a wide place that is not a glimpse, or if it joins places that stay and is not wide with hardly any walls, like a
    yard behind windows. Everything stays if the place of the start, or without a start the largest, is a glimpse.
    """
    half_door = door / 2 - radius
    if half_door < 1 or not (part.grid.cells == UNKNOWN).any():
        return centres
    places, count_wide, count = _places(centres, half_door)
    walls = _wall_shares(places, count, part, centres, radius)
    if walls is None:
        return centres
    glimpse = walls < 0.5
    largest = 1 + int(np.argmax(np.bincount(places.ravel())[1:]))
    home = largest if start is None else int(places[part.cell(start)])
    if glimpse[home] or not glimpse.any():
        return centres
    pairs = _neighbours(places)
    kept = _on_the_way(pairs, glimpse, home, count_wide)
    if kept[1:].all():
        return centres
    small = np.bincount(places.ravel(), minlength=count + 1) < (2 * door - 2 * radius) ** 2  # two doors square
    through = (np.arange(count + 1) > count_wide) | (walls >= BOUNDED_SHARE) | small
    return (kept | _joining(places, pairs, kept, through))[places]


def _places(centres: np.ndarray, half_door: float) -> tuple[np.ndarray, int, int]:
    """Divide the centres where they are narrower than a door; return labels, the number of wide places and of all."""
    wide = dilated(centres & ~dilated(~centres, half_door), half_door) & centres
    places, count_wide = ndimage.label(wide)
    narrow, count_narrow = ndimage.label(centres & ~wide)
    places[narrow > 0] = narrow[narrow > 0] + count_wide
    return places, count_wide, count_wide + count_narrow


def _wall_shares(
    places: np.ndarray, count: int, part: CroppedGrid, centres: np.ndarray, radius: float
) -> np.ndarray | None:
    """Return the share of walls in the outline of each place; None if the only grey is that of drawn lines."""
    free, (row, column), (rows, columns) = part.free, part.corner, part.free.shape
    cells = np.pad(part.grid.cells, 1)[row + 1 : row + 1 + rows, column + 1 : column + 1 + columns]
    unseen = cells == UNKNOWN
    if 2 * np.count_nonzero(dilated(~dilated(~unseen, NEAR), NEAR)) < np.count_nonzero(unseen):
        return None
    bounded = dilated((cells >= FREE_BELOW) & ~free, NEAR)
    outline = dilated(free, 1.5) & ~free & dilated(centres, radius + 1.5)
    nearest = ndimage.distance_transform_edt(places == 0, return_distances=False, return_indices=True)
    place = places[nearest[0][outline], nearest[1][outline]]
    around = np.bincount(place, minlength=count + 1)
    walls = np.bincount(place[bounded[outline]], minlength=count + 1)
    return np.where(around > 0, walls / np.maximum(around, 1), 1.0)


def _neighbours(places: np.ndarray) -> np.ndarray:
    """Return the pairs of labels that meet, in both orders, `(2, n)`."""
    sides = [(places[1:], places[:-1]), (places[:, 1:], places[:, :-1])]
    pairs = np.concatenate([np.stack([a, b])[:, (a != b) & (a > 0) & (b > 0)] for a, b in sides], axis=1)
    return np.unique(np.concatenate([pairs, pairs[::-1]], axis=1), axis=1)


def _on_the_way(pairs: np.ndarray, glimpse: np.ndarray, home: int, count_wide: int) -> np.ndarray:
    """Return which places are reached from home without glimpses, or lead to wide places by the fewest glimpses."""
    from scipy.sparse import csr_array  # slow to import, and only some maps need it
    from scipy.sparse.csgraph import dijkstra

    count = len(glimpse) - 1
    cost = np.where(glimpse[pairs[1]], count + 1, 1)  # a way through all other places is better than through a glimpse
    ways = csr_array((cost, tuple(pairs)), shape=(count + 1, count + 1))
    (distances,), (predecessors,) = dijkstra(ways, indices=[home], return_predecessors=True)
    kept = distances <= count
    for place in 1 + np.flatnonzero(~glimpse[1 : count_wide + 1]):
        while not kept[place]:
            kept[place] = True
            place = predecessors[place]
    return kept


def _joining(places: np.ndarray, pairs: np.ndarray, kept: np.ndarray, through: np.ndarray) -> np.ndarray:
    """Return which other places, among those that can be driven `through`, lead from kept ones back to kept ones.

    A place does if it is on a cycle of the graph of places in which all kept ones are one node. Each separate stretch
    of its outline along which a place meets kept ones is a node, too.
    """
    import networkx as nx

    kept, other = kept.copy(), through & ~kept
    kept[0] = other[0] = False
    if not (kept[pairs[0]] & other[pairs[1]]).any():
        return other & kept
    contact = other[places] & dilated(kept[places], 1.1)
    stretches = ndimage.label(dilated(contact, NEAR), CONNECTED_8)[0]
    graph = nx.Graph(pairs[:, other[pairs].all(axis=0)].T.tolist())
    for place, stretch in np.unique(np.stack([places[contact], stretches[contact]], axis=1), axis=0).tolist():
        graph.add_edges_from([(place, -stretch), (-stretch, "kept")])
    joining = np.zeros(len(kept), bool)
    blocks: Any = nx.biconnected_components(graph)
    for block in blocks:
        if "kept" in block and len(block) > 2:
            joining[[node for node in block if node != "kept" and node > 0]] = True
    return joining
