"""Masks of cells, grown by discs or cell by cell; all lengths are in cells."""

from __future__ import annotations

import math

import numpy as np
from scipy import ndimage

from cyclic_env.jit import compiled


def grow_back(centres: np.ndarray, free: np.ndarray, radius: float, gap: float, nook_cells: float) -> np.ndarray:
    """Grow the cells of a robot's centre back to the walls, into the cells that the robot covers and nooks beside them.

    Parameters
    ----------
    centres, free : (rows, columns) bool
        Where the robot's centre can be, and free space.
    radius : float
        Radius of the robot.
    gap : float
        Free space narrower than this is left out.
    nook_cells : float
        Greatest number of cells of a nook, free space that the robot does not cover.

    Returns
    -------
    (rows, columns) bool
        Connected, and with the same holes as `centres`.
    """
    half_gap = min(max(1, round(gap / 2 + 0.5)), radius)
    wide = dilated(~dilated(~free, half_gap), half_gap)
    covered = dilated(centres, radius)
    beside = ndimage.label(wide & ~covered)[0]
    nooks = np.bincount(beside.ravel()) <= nook_cells
    allowed = wide & ~centres & (covered | nooks[beside])
    space = centres.copy()
    add_cells(space.ravel(), allowed.ravel(), space.shape[1], np.empty(4 * np.count_nonzero(allowed), np.int64))
    return space


def dilated(mask: np.ndarray, radius: float) -> np.ndarray:
    """Return the cells less than `radius` away from a cell of `mask`, centre to centre."""
    reach = np.arange(math.ceil(radius))
    widths = np.ceil(np.sqrt(radius**2 - reach**2)).astype(np.int64) - 1
    result = mask.copy()
    stamp_discs(mask, widths, result)
    return result


@compiled
def stamp_discs(mask, widths, result):
    """Set `result` in discs around the cells of `mask`, which extend `widths[i]` cells to both sides i rows away.

    Cells with four neighbours are skipped, because the discs of those cover theirs.
    """
    rows, columns = mask.shape
    for row in range(rows):
        for column in range(columns):
            if not mask[row, column]:
                continue
            if (
                0 < row < rows - 1
                and 0 < column < columns - 1
                and mask[row - 1, column]
                and mask[row + 1, column]
                and mask[row, column - 1]
                and mask[row, column + 1]
            ):
                continue
            for i in range(max(row - len(widths) + 1, 0), min(row + len(widths), rows)):
                width = widths[abs(i - row)]
                for j in range(max(column - width, 0), min(column + width + 1, columns)):
                    result[i, j] = True


@compiled
def add_cells(space, allowed, columns, queue):
    """Add allowed cells to `space`, nearest first, as long as they neither make a hole in it nor close one.

    Parameters
    ----------
    space, allowed : (rows * columns,) bool
        Row by row, with no cell of either on the rim. The space, which is 4-connected, is grown in place.
    columns : int
    queue : (4 * number of allowed cells,) int64
        Scratch space: a cell waits at most once for each neighbour.
    """
    steps = (1, columns, -1, -columns)
    end = 0
    for cell in range(columns, len(space) - columns):
        if space[cell]:
            for step in steps:
                if allowed[cell + step]:
                    queue[end] = cell + step
                    end += 1
    begin = 0
    while begin < end:
        cell = queue[begin]
        begin += 1
        if space[cell]:
            continue
        joined = 0  # Yokoi's connectivity number: 1 if the cell joins nothing that its neighbours don't
        for i in range(4):
            side, next_side = steps[i], steps[(i + 1) % 4]
            if space[cell + side] and not (space[cell + side + next_side] and space[cell + next_side]):
                joined += 1
        if joined != 1:
            continue
        space[cell] = True
        for step in steps:
            if allowed[cell + step] and not space[cell + step]:
                queue[end] = cell + step
                end += 1
