"""An occupancy grid of all that a robot has sensed, its frontiers, and the cheapest ways over it.

The grid is drawn where dead reckoning says that the robot is, and never corrected. It is that of S. Thrun, W. Burgard
and D. Fox, Probabilistic Robotics, 9.2, with the numbers of OctoMap (A. Hornung et al., Autonomous Robots 34, 2013). A
frontier is a connected set of free cells beside unknown ones (B. Yamauchi, "A frontier-based approach for autonomous
exploration", CIRA 1997).

The kernels do not validate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from agents.component_config import ComponentConfig, kernel_tuple, pack
from agents.slam.scan_filters import SHORT_OF_REACH
from cyclic_env.config import LaserConfig
from cyclic_env.jit import compiled


@dataclass(frozen=True, slots=True, kw_only=True)
class OccupancyConfig(ComponentConfig):
    """The grid and what a way over it costs; lengths in metres."""

    cell: float = 0.2
    hit: float = 0.85
    miss: float = 0.4
    bound: float = 3.5
    """Log-odds that an endpoint adds to its cell, that a beam that passes takes off, and at most, either way."""
    wall_depth: float = 0.05
    """How far behind an endpoint the wall's cell is: the surface is the near side of the wall."""
    clearance: float = 0.28
    """Distance between the centres of a cell that the robot may be in and one with a wall."""
    comfort: float = 0.7
    comfort_cost: float = 1.5
    """Distance from walls up to which a metre costs more, and how much more at a wall."""
    escape: float = 0.6
    escape_cost: float = 10.0
    """If the robot is where it can't be, it gets out within this distance, at this cost of a metre."""
    margin_cells: int = 80
    """Cells by which the grid grows beyond what is sensed, each time that it is too small."""


OccupancyValues = kernel_tuple("OccupancyValues", OccupancyConfig, __name__)


class Frontier(NamedTuple):
    """A connected set of frontier cells that the robot can get to."""

    cells: int
    cost: float
    """Of the cheapest way to the nearest of them."""
    goal: int
    """That cell, as a flat index."""


@compiled
def draw_scan(log_odds, corner, scan, laser, pose, box, values):
    """Add a scan to the cells of a box `(4,)` of rows and columns: what is surely free, and where beams end.

    `laser` is its reach, first bearing, beam spacing, and whether it sees all around.
    """
    n, cell = scan.shape[0], values.cell
    range_max, first_bearing, spacing, all_around = laser
    for i in range(box[0], box[1]):
        for j in range(box[2], box[3]):
            dx, dy = corner[0] + (j + 0.5) * cell - pose[0], corner[1] + (i + 0.5) * cell - pose[1]
            distance = math.sqrt(dx * dx + dy * dy)
            if distance > range_max:
                continue
            angle = math.atan2(dy, dx) - pose[2] - first_bearing
            low = math.floor((angle - 2 * math.pi * math.floor(angle / (2 * math.pi))) / spacing)
            if low + 1 >= n and not all_around:
                continue
            if distance < min(scan[low % n], scan[(low + 1) % n]) - 0.5 * cell:
                log_odds[i, j] = max(log_odds[i, j] - values.miss, -values.bound)
    for k in range(n):
        if scan[k] < range_max - SHORT_OF_REACH:
            reach, angle = scan[k] + values.wall_depth, pose[2] + first_bearing + k * spacing
            i = math.floor((pose[1] + reach * math.sin(angle) - corner[1]) / cell)
            j = math.floor((pose[0] + reach * math.cos(angle) - corner[0]) / cell)
            log_odds[i, j] = min(log_odds[i, j] + values.hit, values.bound)


@compiled
def cost_cells(log_odds, box, cost, values):
    """Write the cost of a metre in each cell of a box: inf where the robot can't be, or nothing is known."""
    reach = int(values.comfort / values.cell) + 1
    rows, columns = log_odds.shape
    for i in range(box[0], box[1]):
        for j in range(box[2], box[3]):
            cost[i, j] = math.inf if log_odds[i, j] >= 0.0 else 1.0
    for i in range(max(0, box[0] - reach), min(rows, box[1] + reach)):
        for j in range(max(0, box[2] - reach), min(columns, box[3] + reach)):
            if log_odds[i, j] <= 0.0:
                continue
            for a in range(max(box[0], i - reach), min(box[1], i + reach + 1)):
                for b in range(max(box[2], j - reach), min(box[3], j + reach + 1)):
                    distance = values.cell * math.sqrt((a - i) ** 2 + (b - j) ** 2)
                    if distance <= values.clearance:
                        cost[a, b] = math.inf
                    elif distance < values.comfort:
                        more = values.comfort_cost * (values.comfort - distance) / values.comfort
                        cost[a, b] = max(cost[a, b], 1.0 + more)


@compiled
def spread_costs(cost, start, costs_to_go, before, queue, waiting, values):
    """Write the cost of the cheapest way from a cell (row, column) to each other, and the flat cell before it.

    `queue` `(rows * columns,)` and `waiting` `(rows, columns)` are scratch.
    """
    rows, columns = cost.shape
    for i in range(rows):
        for j in range(columns):
            costs_to_go[i, j] = math.inf
            before[i, j] = -1
            waiting[i, j] = False
    escape, size = (values.escape / values.cell) ** 2, rows * columns
    costs_to_go[start[0], start[1]] = 0.0
    queue[0], head, count = start[0] * columns + start[1], 0, 1
    while count > 0:
        cell = queue[head]
        head = (head + 1) % size
        count -= 1
        i, j = cell // columns, cell % columns
        waiting[i, j] = False
        for a in range(max(0, i - 1), min(rows, i + 2)):
            for b in range(max(0, j - 1), min(columns, j + 2)):
                each = cost[a, b]
                if each == math.inf:
                    if (a - start[0]) ** 2 + (b - start[1]) ** 2 > escape:
                        continue
                    each = values.escape_cost
                total = costs_to_go[i, j] + each * values.cell * math.sqrt((a - i) ** 2 + (b - j) ** 2)
                if total < costs_to_go[a, b] - 1e-9:
                    costs_to_go[a, b] = total
                    before[a, b] = cell
                    if not waiting[a, b]:
                        queue[(head + count) % size] = a * columns + b
                        count += 1
                        waiting[a, b] = True


@compiled
def label_frontiers(log_odds, banned, costs_to_go, waiting, queue, out):
    """Write the connected frontiers into `out` `(most, 3)`: cells, cost, and the flat index of the nearest cell.

    Returns how many there are. `waiting` and `queue` are scratch; cells that are `banned` are none.
    """
    rows, columns = log_odds.shape
    for i in range(rows):
        for j in range(columns):
            waiting[i, j] = False
            if log_odds[i, j] < 0.0 and not banned[i, j] and 0 < i < rows - 1 and 0 < j < columns - 1:
                unknown = log_odds[i - 1, j] == 0.0 or log_odds[i + 1, j] == 0.0
                waiting[i, j] = unknown or log_odds[i, j - 1] == 0.0 or log_odds[i, j + 1] == 0.0
    found = 0
    for i in range(rows):
        for j in range(columns):
            if not waiting[i, j] or found == out.shape[0]:
                continue
            waiting[i, j] = False
            queue[0], head, count = i * columns + j, 0, 1
            cost, goal = math.inf, -1
            while head < count:
                cell = queue[head]
                head += 1
                r, c = cell // columns, cell % columns
                if costs_to_go[r, c] < cost:
                    cost, goal = costs_to_go[r, c], cell
                for a in range(max(0, r - 1), min(rows, r + 2)):
                    for b in range(max(0, c - 1), min(columns, c + 2)):
                        if waiting[a, b]:
                            waiting[a, b] = False
                            queue[count] = a * columns + b
                            count += 1
            if goal >= 0:
                out[found, 0], out[found, 1], out[found, 2] = count, cost, goal
                found += 1
    return found


@compiled
def in_free_space(log_odds, first, last):
    """Tell whether the straight line between two points, in cells (x, y), crosses no wall."""
    dx, dy = last[0] - first[0], last[1] - first[1]
    steps = int(2 * math.sqrt(dx * dx + dy * dy)) + 1
    for step in range(steps + 1):
        i, j = math.floor(first[1] + dy * step / steps), math.floor(first[0] + dx * step / steps)
        if log_odds[i, j] > 0.0:
            return False
    return True


class OccupancyGrid:
    """The grid, which grows with what the robot senses, and what is found on it.

    Parameters
    ----------
    laser : LaserConfig
    config : OccupancyConfig, optional

    Attributes
    ----------
    range_max : float
        Reach of the laser, metres.
    log_odds : (rows, columns) float32
        Below 0 free, above 0 a wall, 0 unknown.
    corner : (2,) float64
        South-western corner of the grid, metres.
    """

    MOST_FRONTIERS = 4_000

    def __init__(self, laser: LaserConfig, config: OccupancyConfig | None = None) -> None:
        self.range_max = laser.range_max
        self._laser = (laser.range_max, laser.first_bearing, laser.beam_spacing, laser.sees_all_around)
        self.config = config or OccupancyConfig()
        self._values: Any = pack(OccupancyValues, self.config)
        self.corner = np.zeros(2)
        self.log_odds, self._banned = np.zeros((1, 1), np.float32), np.zeros((1, 1), np.bool_)
        self._cost = np.full((1, 1), np.inf, np.float32)
        self._found = np.empty((self.MOST_FRONTIERS, 3))
        self._make_scratch()

    def _make_scratch(self) -> None:
        shape = self.log_odds.shape
        self._costs_to_go, self._before = np.full(shape, np.inf, np.float32), np.zeros(shape, np.int32)
        self._queue, self._waiting = np.zeros(shape[0] * shape[1], np.int32), np.zeros(shape, np.bool_)

    def add(self, scan: np.ndarray, pose: np.ndarray) -> None:
        """Draw a scan `(beams,)` that was taken at a pose `(3,)`."""
        cell, reach = self.config.cell, self.range_max + 2 * self.config.cell
        low = np.floor((pose[:2] - reach - self.corner) / cell).astype(int)
        high = np.ceil((pose[:2] + reach - self.corner) / cell).astype(int)
        rows, columns = self.log_odds.shape
        if (low < 1).any() or high[0] > columns - 1 or high[1] > rows - 1:
            low, high = self._grow(low, high)
        box = np.array([low[1], high[1], low[0], high[0]])
        draw_scan(self.log_odds, self.corner, scan, self._laser, pose, box, self._values)
        border = math.ceil(self.config.comfort / cell)
        rows, columns = self.log_odds.shape
        box += np.array([-border, border, -border, border])
        box = np.clip(box, 0, [rows, rows, columns, columns])
        cost_cells(self.log_odds, box, self._cost, self._values)

    def _grow(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Make the grid large enough for the columns and rows from `low` to `high`; return these in the new one."""
        rows, columns = self.log_odds.shape
        margin = self.config.margin_cells
        before = np.where(low < 1, margin - low, 0)
        after = np.where(high > np.array([columns, rows]) - 1, high - np.array([columns, rows]) + margin, 0)
        pads = ((before[1], after[1]), (before[0], after[0]))
        self.log_odds = np.pad(self.log_odds, pads)
        self._banned = np.pad(self._banned, pads)
        self._cost = np.pad(self._cost, pads, constant_values=np.inf)
        self.corner = self.corner - before * self.config.cell
        self._make_scratch()
        return low + before, high + before

    def find_ways(self, pose: np.ndarray) -> None:
        """Find the cheapest ways from a pose to everywhere."""
        i, j = self._cell(pose)
        spread_costs(self._cost, (i, j), self._costs_to_go, self._before, self._queue, self._waiting, self._values)

    def frontiers(self, least_cells: int) -> list[Frontier]:
        """Return the frontiers of at least so many cells that a way leads to; after `find_ways`."""
        count = label_frontiers(self.log_odds, self._banned, self._costs_to_go, self._waiting, self._queue, self._found)
        return [
            Frontier(int(cells), float(cost), int(goal))
            for cells, cost, goal in self._found[:count]
            if cells >= least_cells
        ]

    def is_frontier(self, point: np.ndarray) -> bool:
        """Tell whether a point `(2,)` is still in a free cell beside an unknown one."""
        i, j = self._cell(point)
        around = self.log_odds[[i - 1, i + 1, i, i], [j, j, j - 1, j + 1]]
        return bool(self.log_odds[i, j] < 0 and (around == 0).any())

    def ban(self, point: np.ndarray, radius: float) -> None:
        """Take no cell within a radius of a point `(2,)` for a frontier any more."""
        i, j = self._cell(point)
        reach = math.ceil(radius / self.config.cell)
        self._banned[max(i - reach, 0) : i + reach + 1, max(j - reach, 0) : j + reach + 1] = True

    def costs_to(self, points: np.ndarray) -> np.ndarray:
        """Return the costs `(n,)` of the ways to points `(n, 2)` on the grid; inf where there is none."""
        cells = np.floor((points - self.corner) / self.config.cell).astype(int)
        return self._costs_to_go[cells[:, 1], cells[:, 0]].astype(np.float64)

    def cell_at(self, point: np.ndarray) -> int:
        """Return the cell that a point `(2,)` is in, as a flat index."""
        i, j = self._cell(point)
        return i * self.log_odds.shape[1] + j

    def way_to(self, cell: int) -> np.ndarray:
        """Return the centres `(m, 2)` of the cells on the way to a cell, the robot's first."""
        columns, way = self.log_odds.shape[1], [cell]
        while self._before[way[-1] // columns, way[-1] % columns] >= 0:
            way.append(int(self._before[way[-1] // columns, way[-1] % columns]))
        flat = np.array(way[::-1])
        return (np.column_stack([flat % columns, flat // columns]) + 0.5) * self.config.cell + self.corner

    def sees(self, first: np.ndarray, last: np.ndarray) -> bool:
        """Tell whether no wall is known between two points `(2,)` on the grid."""
        size = self.config.cell
        return bool(in_free_space(self.log_odds, (first - self.corner) / size, (last - self.corner) / size))

    def _cell(self, point: np.ndarray) -> tuple[int, int]:
        x, y = np.floor((point[:2] - self.corner) / self.config.cell)
        return int(y), int(x)
