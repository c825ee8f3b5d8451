"""Buildings generated from a seed: blocks on an irregular grid, corridors around them, dead ends, rooms and niches.

The dial `aliasing` works by one principle. Each choice that shapes a place (the width and the niches of a corridor, the
spacing of the grid, the size of a room) is with that probability the building's standard choice, and otherwise drawn
for that place alone. At 1 the same corridor, block and room are everywhere, so places look alike; at 0 each is unique.

Everything is drawn by ``random()`` of PCG64 in an order that the specification fixes, and rounded to the centimetre
before any geometry. A specification therefore gives the same building in every process and on every machine, for good.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import shapely
from shapely.geometry import LineString

from cyclic_env.errors import FloorPlanError
from cyclic_env.floor_plans.floor_plan import RESOLUTION, FloorPlan
from cyclic_env.floor_plans.generator.layout import (
    MAX_SLOTS,
    Box,
    Corridor,
    Module,
    Node,
    Point,
    grow_edges,
    grow_path,
)
from cyclic_env.floor_plans.generator.spec import BuildingSpec, Draw

WALL = 0.5
"""Least thickness of the wall between two parts of a building, except where they are joined, metres."""
WIDTH_MIN = 1.6
SPACING, WIDTHS = (0.75, 1.4), (0.75, 1.3)
"""Least and greatest spacing of the grid and width of a corridor, as shares of `size` and `width`."""
CUT = (0.18, 0.25)
"""Share of the length of the shorter corridor that a cut corner removes."""
DOUBLE_BLOCKS = 0.4
"""Share of double blocks, which are two joined into one, among those that are not the standard block."""
SPUR = (0.3, 0.6)
"""Length of a dead end as a share of `size`."""
SPUR_WALL = 1.0
"""Least thickness of the wall around a dead end, metres."""
TREE_CORRIDORS = 4
"""Number of stretches of corridor in a building without cycles, not counting dead ends."""
NICHE_LENGTH, NICHE_DEPTH = (1.2, 4.5), (0.6, 1.8)
PLAIN, PILLARED = 0.25, 0.85
"""A slot with a random number below the first has a plain wall; above the second, a large niche with a pillar."""
PILLAR, PILLARED_LENGTH, PILLARED_DEPTH = 0.5, 3.2, 1.6
"""Side of a pillar, and the smallest niche with one, such that the robot passes behind it, metres."""
DOOR_WIDTH, DOOR_DEPTH = (1.0, 1.5), 0.6
ROOM_LENGTH, ROOM_DEPTH = (3.5, 6.5), (3.0, 5.5)


@lru_cache(maxsize=1024)
def generate(spec: BuildingSpec, name: str = "") -> FloorPlan:
    """Generate the building of a specification, always the same one.

    Parameters
    ----------
    spec : BuildingSpec
    name : str
        The plan's name; by default the specification's.

    Raises
    ------
    FloorPlanError
        If there is no space for the dead ends.
    """
    return _Builder(spec).plan(name or spec.name)


class _Builder:
    """A building in the making: first the corridors, then what lies beside them, each part only where it has space."""

    def __init__(self, spec: BuildingSpec) -> None:
        self.spec = spec
        self.layout, self.decor = (Draw(spec.seed, stream) for stream in (1, 2))
        self.lines: list[tuple[Point, ...]] = []  # centrelines
        self.taken: list[Box] = []  # bounding boxes of all parts
        self.free: list[Box] = []  # corridors and doors
        self.beside: list[Box] = []  # rooms and niches, which don't touch each other
        self.diagonals: list[tuple[float, list[Point]]] = []  # width and line of the corridors that cut corners
        self.pillars: list[Box] = []
        self.standard = self._own_module()._replace(width=2 * round(spec.width / 2, 2))
        self.standard_cut, self.standard_spur = self.layout.between(*CUT), self.layout.between(*SPUR)
        self.halls = self._lay_halls()
        self.start = self.halls[self.layout.below(len(self.halls))]
        corridors = [*self.halls, *self._lay_dead_ends(spec.dead_ends if spec.cycles else spec.dead_ends - 2)]
        for corridor in corridors:
            self._lay_room(corridor)
        for corridor in corridors:
            self._lay_niches(corridor)

    def plan(self, name: str) -> FloorPlan:
        """Assemble the floor plan."""
        spec, start = self.spec, self.start
        around = [
            LineString(line).buffer(width / 2, cap_style="square", join_style="mitre") for width, line in self.diagonals
        ]
        space = shapely.union_all([*_boxes(self.free), *around])
        # A union of two shapes is much faster than one of hundreds.
        space = shapely.union(space, shapely.multipolygons(_boxes(self.beside)))
        space = shapely.difference(space, shapely.multipolygons(_boxes(self.pillars)))
        space = shapely.simplify(shapely.set_precision(space, RESOLUTION), RESOLUTION)
        cycles = f"{spec.cycles} cycle{'' if spec.cycles == 1 else 's'}"
        return FloorPlan(
            name=name,
            free_space=space,  # pyright: ignore[reportArgumentType] (FloorPlan checks that it is one polygon)
            start=(*start.at(start.length / 2), math.atan2(start.along[1], start.along[0])),
            title=f"Generated building: {cycles}, aliasing {spec.aliasing:g}, seed {spec.seed}",
            source=f"CyclicLoop's generator: {spec.name}",
            licence="MIT",
            centrelines=tuple(self.lines),
        )

    def _lay_halls(self) -> list[Corridor]:
        """Lay the corridors around the blocks, or those of a tree, and cut corners; return the straight corridors."""
        spec, layout = self.spec, self.layout
        if spec.cycles:
            doubled = [not standard and double for standard, double in self._chances(DOUBLE_BLOCKS, spec.cycles)]
            edges = grow_edges(layout, spec.cycles, sum(doubled))
        else:
            edges = grow_path(layout, TREE_CORRIDORS)
        nodes = sorted({node for edge in edges for node in edge})
        x, y = (self._grid_lines(min(line), max(line)) for line in zip(*nodes, strict=True))
        modules = [self._module() for _ in edges]
        lengths = [x[b[0]] - x[a[0]] + y[b[1]] - y[a[1]] for a, b in edges]
        cuts: dict[Node, float] = {}
        for node in nodes:
            meeting = [i for i, edge in enumerate(edges) if node in edge]
            cut, share = layout.chance(spec.diagonal), layout.between(*CUT)
            straight = len({edges[i][0][0] == edges[i][1][0] for i in meeting}) < 2
            if len(meeting) == 2 and cut and not straight:
                share = self.standard_cut if layout.chance(spec.aliasing) else share
                cuts[node] = round(share * min(lengths[i] for i in meeting), 2)
        halls = []
        for (a, b), module, length in zip(edges, modules, lengths, strict=True):
            first, last = cuts.get(a, 0.0), length - cuts.get(b, 0.0)
            hall = Corridor((x[a[0]], y[a[1]]), (b[0] - a[0], b[1] - a[1]), length, module, first, last)
            halls.append(hall)
            # It fills its corners with other corridors, but ends where a diagonal begins.
            begin, end = first - hall.half * (a not in cuts), last + hall.half * (b not in cuts)
            self._take(hall.box(begin, end, -hall.half, hall.half), self.free)
            self.lines.append((hall.at(first), hall.at(last)))
        for (i, j), cut in cuts.items():
            meeting = [k for k, edge in enumerate(edges) if (i, j) in edge]
            self._lay_diagonal((x[i], y[j]), cut, [halls[k] for k in meeting])
        return halls

    def _lay_diagonal(self, corner: Point, cut: float, halls: Sequence[Corridor]) -> None:
        """Lay the corridor that cuts the corner of two halls, as wide as the wider one."""
        width = max(hall.module.width for hall in halls)
        legs = [[d if hall.base == corner else -d for d in hall.along] for hall in halls]
        near, far = (
            [(round(corner[0] + s * dx, 2), round(corner[1] + s * dy, 2)) for dx, dy in legs]
            for s in (cut, cut + width / 2)
        )
        self.lines.append((near[0], near[1]))
        self.diagonals.append((width, [far[0], near[0], near[1], far[1]]))
        # Its bounding box ends where its outer wall meets that of a hall, a mitre beyond the cut.
        ahead = cut + math.tan(math.pi / 8) * width / 2
        (west, east), (south, north) = (
            sorted((at - side * width / 2, at + side * ahead))
            for at, side in zip(corner, map(sum, zip(*legs, strict=True)), strict=True)
        )
        self.taken.append((west, south, east, north))

    def _grid_lines(self, first: int, last: int) -> dict[int, float]:
        """Return the coordinates in metres of the grid's lines with those numbers."""
        size = self.spec.size
        lines = {first: 0.0}
        for i in range(first, last):
            own = self.layout.between(max(SPACING[0] * size, self.spec.spacing_min), SPACING[1] * size)
            standard = self.layout.chance(self.spec.aliasing)
            lines[i + 1] = round(lines[i] + (round(size, 2) if standard else own), 2)
        return lines

    def _chances(self, share: float, count: int) -> list[tuple[bool, bool]]:
        """Return for each of `count` choices whether it is the standard one, and the outcome of a chance of `share`."""
        return [(self.layout.chance(self.spec.aliasing), self.layout.chance(share)) for _ in range(count)]

    def _own_module(self) -> Module:
        width = max(self.spec.width * (WIDTHS[0] + (WIDTHS[1] - WIDTHS[0]) * self.decor.shares(1)[0]), WIDTH_MIN)
        return Module(2 * round(width / 2, 2), self.decor.shares(2, MAX_SLOTS, 4), self.decor.shares(5))

    def _module(self) -> Module:
        own = self._own_module()
        return self.standard if self.decor.chance(self.spec.aliasing) else own

    def _take(self, box: Box, kind: list[Box]) -> None:
        kind.append(box)
        self.taken.append(box)

    def _around(self, host: Corridor, reach: float) -> list[Box]:
        """Return the boxes of the parts within `reach` of a corridor, without those inside it."""
        west, south, east, north = host.box(-reach, host.length + reach, -reach, reach)
        own = host.half + 0.01
        left, bottom, right, top = host.box(-own, host.length + own, -own, own)
        return [
            (w, s, e, n)
            for w, s, e, n in self.taken
            if w < east and e > west and s < north and n > south
            if w < left or s < bottom or e > right or n > top
        ]

    def _lay_dead_ends(self, count: int) -> list[Corridor]:
        """Lay corridors that branch off halls and end blindly, in a random order of the positions for them."""
        spec, layout, spurs = self.spec, self.layout, []
        positions = [(hall, s, side) for hall in self.halls for s in hall.branch_positions() for side in (1, -1)]
        for hall, s, side in [positions[i] for i in layout.order(len(positions))]:
            if len(spurs) == count:
                break
            module, own = self._module(), layout.between(*SPUR)
            share = self.standard_spur if layout.chance(spec.aliasing) else own
            along = (-side * hall.along[1], side * hall.along[0])
            length = round(hall.half + share * spec.size, 2)
            spur = Corridor(hall.at(s), along, length, module, hall.half, length)
            if _is_clear(
                spur.box(hall.half, length, -spur.half, spur.half), SPUR_WALL, self._around(hall, length + SPUR_WALL)
            ):
                self._take(spur.box(0.0, length, -spur.half, spur.half), self.free)
                self.lines.append((spur.base, spur.at(length - spur.half)))
                spurs.append(spur)
        if len(spurs) < count:
            fit = spec.dead_ends - count + len(spurs)
            raise FloorPlanError(
                f"only {fit} of {spec.dead_ends} dead ends have space; ask for fewer, or for a larger size."
            )
        return spurs

    def _lay_room(self, corridor: Corridor) -> None:
        """Lay a room behind a door, if the corridor is to have one, at the first slot with space for it."""
        wanted = self.decor.chance(self.spec.rooms)
        side, place, length, depth, door = corridor.module.room
        slots = corridor.slots()
        if not wanted or not slots:
            return
        chosen = int(place * len(slots))
        length, depth, door = (
            _between(ends, u) for ends, u in ((ROOM_LENGTH, length), (ROOM_DEPTH, depth), (DOOR_WIDTH, door))
        )
        around = self._around(corridor, corridor.half + DOOR_DEPTH + ROOM_DEPTH[1] + WALL)
        for slot in (*slots[chosen:], *slots[:chosen]):
            middle = sum(slot) / 2
            for left in (side < 0.5, side >= 0.5):
                inner, outer = corridor.half + DOOR_DEPTH, corridor.half + DOOR_DEPTH + depth
                sign = 1 if left else -1
                room = corridor.box(middle - length / 2, middle + length / 2, sign * inner, sign * outer)
                if _is_clear(room, WALL, around):
                    self._take(room, self.beside)
                    self.free.append(corridor.box(middle - door / 2, middle + door / 2, 0.0, sign * inner))
                    return

    def _lay_niches(self, corridor: Corridor) -> None:
        """Lay the niches on both sides of a corridor, some with a pillar, where they have space."""
        around = self._around(corridor, corridor.half + NICHE_DEPTH[1] + WALL)
        for sign, shares in zip((1, -1), corridor.module.niches, strict=True):
            for (begin, end), (kind, length, place, depth) in zip(corridor.slots(), shares, strict=False):
                if kind < PLAIN:
                    continue
                pillared = kind > PILLARED
                longest = min(NICHE_LENGTH[1], end - begin - WALL)
                length = _between((min(PILLARED_LENGTH, longest) if pillared else NICHE_LENGTH[0], longest), length)
                depth = _between((PILLARED_DEPTH if pillared else NICHE_DEPTH[0], NICHE_DEPTH[1]), depth)
                begin = begin + WALL / 2 + place * (end - begin - WALL - length)
                inner, outer = corridor.half, corridor.half + depth
                niche = corridor.box(begin, begin + length, sign * inner, sign * outer)
                if not _is_clear(niche, WALL, around):
                    continue
                self._take(niche, self.beside)
                if pillared:
                    middle = begin + length / 2
                    self.pillars.append(
                        corridor.box(middle - PILLAR / 2, middle + PILLAR / 2, sign * inner, sign * (inner + PILLAR))
                    )


def _boxes(boxes: Sequence[Box]) -> np.ndarray:
    west, south, east, north = np.array(boxes).reshape(-1, 4).T
    return shapely.box(west, south, east, north)


def _is_clear(box: Box, wall: float, others: Sequence[Box]) -> bool:
    """Tell whether the wall between a box and each of the others is at least that thick."""
    west, south, east, north = box[0] - wall, box[1] - wall, box[2] + wall, box[3] + wall
    return not any(w < east and e > west and s < north and n > south for w, s, e, n in others)


def _between(ends: tuple[float, float], share: float) -> float:
    return round(ends[0] + (ends[1] - ends[0]) * share, 2)
