"""The map of each robot, a grid of half-metre cells, and the search over it that tells what lies in each heading.

A grid has no edges: it joins its left side to its right one and its bottom to its top, so that a robot may begin
anywhere in a building that is smaller than the grid.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from cyclic_env.jit import compiled

CELL = 0.5
"""Metres."""
SIDE = 512
"""Cells to a side, a power of two: 256 m."""
WRAP = SIDE - 1
DRIVEN_RADIUS = 5
"""Cells in sight of the robot, so far away, in which it counts as having been."""
COUNT_MAX = 250
BRANCH = 2.0
"""Metres from the robot at which ways are told apart by their headings."""
NEAR, FAR = 20.0, 40.0
"""Metres over which the nearness and the mass of what lies ahead fall to 1 / e."""
RECENT = 60.0
"""Decisions over which what was driven lately falls to 1 / e."""
UNREACHED = 1e9


class Grid(NamedTuple):
    """The maps of N robots."""

    free: np.ndarray
    """How many beams have crossed a cell, `(N, SIDE, SIDE)` uint8."""
    hit: np.ndarray
    """How many beams have ended in it, `(N, SIDE, SIDE)` uint8."""
    driven: np.ndarray
    """The last decision at which the robot was there, `(N, SIDE, SIDE)` int16; -1 where it wasn't."""


class SearchScratch(NamedTuple):
    """Working memory of one thread; a cell is new in a search unless `stamp` has the number of the search."""

    distance: np.ndarray
    heading: np.ndarray
    stamp: np.ndarray
    queue: np.ndarray
    number: np.ndarray


class Ahead(NamedTuple):
    """What lies in each of H headings; of one thread."""

    undriven: np.ndarray
    unseen: np.ndarray
    undriven_mass: np.ndarray
    unseen_mass: np.ndarray
    recent: np.ndarray


def allocate_grid(robots: int) -> Grid:
    """Return empty maps."""
    shape = (robots, SIDE, SIDE)
    return Grid(free=np.zeros(shape, np.uint8), hit=np.zeros(shape, np.uint8), driven=np.full(shape, -1, np.int16))


def allocate_search_scratch() -> SearchScratch:
    """Return the working memory of one thread."""
    return SearchScratch(
        distance=np.zeros(SIDE * SIDE, np.int32),
        heading=np.zeros(SIDE * SIDE, np.int8),
        stamp=np.zeros(SIDE * SIDE, np.int64),
        queue=np.zeros(SIDE * SIDE, np.int32),
        number=np.zeros(1, np.int64),
    )


@compiled
def clear_map(grid, i):
    """Forget the map of robot i."""
    grid.free[i] = 0
    grid.hit[i] = 0
    grid.driven[i] = -1


@compiled
def draw_scan(grid, i, x, y, heading, scan, range_max, decision):
    """Draw a scan `(beams,)` taken at a pose into the map of robot i, and that it was there at a decision."""
    free, hit, driven = grid.free[i], grid.hit[i], grid.driven[i]
    n = scan.shape[0]
    spacing = 2 * math.pi / n
    column0, row0 = x / CELL, y / CELL
    for k in range(n):
        cos, sin = math.cos(heading + k * spacing) / CELL, math.sin(heading + k * spacing) / CELL
        r, along = scan[k], 0.0
        while along < r - 0.25:
            row, column = math.floor(row0 + along * sin) & WRAP, math.floor(column0 + along * cos) & WRAP
            if free[row, column] < COUNT_MAX:
                free[row, column] += 1
            along += 0.4
        if r < range_max - 0.05:
            r += 0.05  # the surface is the near side of the wall
            row, column = math.floor(row0 + r * sin) & WRAP, math.floor(column0 + r * cos) & WRAP
            if hit[row, column] < COUNT_MAX:
                hit[row, column] += 1
    for a in range(-DRIVEN_RADIUS, DRIVEN_RADIUS + 1):
        for b in range(-DRIVEN_RADIUS, DRIVEN_RADIUS + 1):
            if a * a + b * b > DRIVEN_RADIUS * DRIVEN_RADIUS:
                continue
            beam = round((math.atan2(float(a), float(b)) - heading) / spacing) % n
            if scan[beam] > CELL * math.sqrt(float(a * a + b * b)) - 0.6:
                driven[(math.floor(row0) + a) & WRAP, (math.floor(column0) + b) & WRAP] = decision


@compiled
def search(grid, i, robot, scratch, ahead):
    """Search the map of robot i breadth first from the robot, and write what lies in each heading into `ahead`.

    Headings count from the robot's own, counter-clockwise; a cell lies in the one in which its way leaves a circle of
    `BRANCH` metres. Cells are undriven where the robot has not been, and unseen where it has not been and the map
    around them has gaps.
    """
    free, hit, driven = grid.free[i], grid.hit[i], grid.driven[i]
    headings = ahead.undriven.shape[0]
    sector = 2 * math.pi / headings
    for h in range(headings):
        ahead.undriven[h], ahead.unseen[h] = UNREACHED, UNREACHED
        ahead.undriven_mass[h], ahead.unseen_mass[h], ahead.recent[h] = 0.0, 0.0, 0.0
    row0, column0 = math.floor(robot.y / CELL) & WRAP, math.floor(robot.x / CELL) & WRAP
    scratch.number[0] += 1
    number = scratch.number[0]
    start = row0 * SIDE + column0
    scratch.queue[0], scratch.distance[start], scratch.heading[start], scratch.stamp[start] = start, 0, -1, number
    head, tail = 0, 1
    while head < tail:
        cell = scratch.queue[head]
        head += 1
        row, column = cell // SIDE, cell % SIDE
        steps, heading = scratch.distance[cell], scratch.heading[cell]
        new = driven[row, column] < 0
        gaps = 0
        for a in range(-1, 2):
            for b in range(-1, 2):
                diagonal = a != 0 and b != 0
                if (a == 0 and b == 0) or (diagonal and not new):
                    continue
                row2, column2 = (row + a) & WRAP, (column + b) & WRAP
                crossed, ended = free[row2, column2], hit[row2, column2]
                if new and crossed == 0 and ended == 0:
                    gaps += 1
                other = row2 * SIDE + column2
                # A beam that grazes a wall crosses its cells too; a stray end in free space is noise.
                if diagonal or scratch.stamp[other] == number or crossed < 1 or 3 * ended >= crossed + 2:
                    continue
                scratch.stamp[other], scratch.distance[other] = number, steps + 1
                its = heading
                if its < 0 and (steps + 1) * CELL >= BRANCH:
                    dy = ((row2 - row0 + SIDE // 2) & WRAP) - SIDE // 2
                    dx = ((column2 - column0 + SIDE // 2) & WRAP) - SIDE // 2
                    its = math.floor((math.atan2(float(dy), float(dx)) - robot.heading) / sector + 0.5) % headings
                    last = driven[row2, column2]
                    if last >= 0:
                        lately = math.exp(-(robot.decisions - last) / RECENT)
                        ahead.recent[its] = max(ahead.recent[its], lately)
                scratch.heading[other] = its
                scratch.queue[tail] = other
                tail += 1
        if new and heading >= 0:
            metres = steps * CELL
            weight = math.exp(-metres / FAR)
            ahead.undriven[heading] = min(ahead.undriven[heading], metres)
            ahead.undriven_mass[heading] += weight
            if gaps >= 2 and free[row, column] >= 2:
                ahead.unseen[heading] = min(ahead.unseen[heading], metres)
                ahead.unseen_mass[heading] += weight
