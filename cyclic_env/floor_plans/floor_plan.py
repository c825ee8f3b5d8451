"""The floor plan of a building: its free space, the start, and the cycles to close."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import shapely
from shapely.geometry import LinearRing, LineString, Point, Polygon
from shapely.geometry.polygon import orient
from shapely.ops import nearest_points
from shapely.validation import explain_validity

from cyclic_env.config import ClosureConfig, RobotConfig
from cyclic_env.errors import FloorPlanError
from cyclic_env.floor_plans.cycles import find_cycles
from cyclic_env.validation import short_repr

MIN_CYCLE_LENGTH = 40.0
"""Least length of the lap around a cycle, metres: twice the path length that a closure requires, so that pillars and
tables are not cycles."""

NOOK_AREA = 1.0
"""Greatest area of a nook or corner that the robot need not cover, because the laser sees it, square metres."""

LOST_SHARE_MAX = 0.02
"""Greatest share of the free space that may lie in larger places that the robot can't cover."""

RESOLUTION = 1e-6
"""Points closer together than this count as one, metres: far finer than any survey, far coarser than rounding."""

COORDINATE_MAX = 1e5
"""Greatest coordinate, metres: at 100 km a float64 still resolves far less than a nanometre."""

SMALLER_ROBOT = "give a smaller robot, such as robot={'radius': 0.2}"
"""The remedy that errors name if the robot is too large."""

Pose = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class FloorPlan:
    """The free space of a building, a polygon with holes in metres (x east, y north), with a start pose.

    Parameters
    ----------
    name : str
        Short name, unique in a pool of plans.
    free_space : shapely Polygon
        Where a point robot may be. It must be valid; it is oriented with free space to the left of every wall.
    start : (x, y, heading)
        Default start pose, metres and radians.
    title, source, licence : str
        Texts for people: what the building is, where the plan comes from, and what may be done with it.
    centrelines : sequence of sequences of (x, y)
        Centrelines of the corridors, if known, as polylines that meet or cross where corridors do.
    file : str
        The file that the plan was read from, if any, for error messages.
    traced : bool
        Whether the file is a map, which is traced again for a robot of another radius.
    robot_radius, leave_radius : float
        Radius of the robot that the cycles (and the tracing) are for, and the least extent of a lap, metres.

    Raises
    ------
    FloorPlanError
        If the polygon is empty, crosses itself or is too far from the origin, or the start is not inside it.
    """

    name: str
    free_space: Polygon
    start: Pose
    title: str = ""
    source: str = ""
    licence: str = ""
    centrelines: tuple[tuple[tuple[float, float], ...], ...] = field(default=())
    file: str = ""
    traced: bool = False
    robot_radius: float = RobotConfig().radius
    leave_radius: float = ClosureConfig().leave_radius

    def __post_init__(self) -> None:
        polygon = self.free_space
        if isinstance(polygon, Polygon):
            if not (np.abs(shapely.get_coordinates(polygon)) <= COORDINATE_MAX).all():
                raise FloorPlanError(
                    f"{self._label}: the free space has coordinates beyond {-COORDINATE_MAX:g} to "
                    f"{COORDINATE_MAX:g}; move the building to the origin, and give metres."
                )
            # Repeated points would make walls without a direction, and heights a third column.
            polygon = shapely.remove_repeated_points(shapely.force_2d(polygon), RESOLUTION)
        if not isinstance(polygon, Polygon) or polygon.is_empty:
            raise FloorPlanError(f"{self._label}: the free space must be one polygon that is not empty.")
        if not polygon.is_valid:
            raise FloorPlanError(
                f"{self._label}: the free space is not a proper polygon ({explain_validity(polygon)}); "
                "no wall may cross another, and holes must lie inside."
            )
        object.__setattr__(self, "free_space", orient(polygon, 1.0))
        try:
            x, y, heading = (float(value) for value in self.start)
        except (TypeError, ValueError, OverflowError):
            x = y = heading = math.nan
        if not all(abs(value) <= COORDINATE_MAX for value in (x, y, heading)):  # false for NaN
            raise FloorPlanError(
                f"{self._label}: start must be finite (x, y, heading), from {-COORDINATE_MAX:g} to "
                f"{COORDINATE_MAX:g}, got {short_repr(self.start)}."
            )
        object.__setattr__(self, "start", (x, y, heading))
        self._check_inside(x, y)

    @property
    def _label(self) -> str:
        return self.file or f"floor plan {self.name!r}"

    def _check_inside(self, x: float, y: float) -> None:
        if not self.free_space.contains(Point(x, y)):
            inside = self.free_space.representative_point()
            raise FloorPlanError(
                f"{self._label}: start ({x:g}, {y:g}) is inside a wall or outside the building; "
                f"choose a point in free space, for example ({inside.x:.1f}, {inside.y:.1f})."
            )

    @cached_property
    def rings(self) -> list[np.ndarray]:
        """Exterior and holes, each `(n, 2)` without the closing point; free space lies to the left."""
        polygon = self.free_space
        return [np.array(ring.coords)[:-1] for ring in (polygon.exterior, *polygon.interiors)]

    @cached_property
    def walls(self) -> np.ndarray:
        """All walls as directed segments `(W, 4)`: x1, y1, x2, y2; free space lies to the left."""
        return np.concatenate([np.hstack([ring, np.roll(ring, -1, axis=0)]) for ring in self.rings])

    @cached_property
    def cycles(self) -> list[Polygon]:
        """The holes that the robot can drive around in a lap that counts, those with the longest rings first.

        The lap is as short as possible, at least 40 m long, and has two points at least `leave_radius` apart.
        """
        return find_cycles(self.free_space, self.start, self.robot_radius, MIN_CYCLE_LENGTH, self.leave_radius)

    @cached_property
    def cycle_anchors(self) -> np.ndarray:
        """A point inside the hole of each cycle, `(C, 2)`, about which winding numbers are counted."""
        points = [hole.representative_point() for hole in self.cycles]
        return np.array([[point.x, point.y] for point in points]).reshape(-1, 2)

    @property
    def cycles_total(self) -> int:
        """Number of independent cycles to close."""
        return len(self.cycles)

    @property
    def free_area(self) -> float:
        """Area of the free space, square metres."""
        return self.free_space.area

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """West, south, east and north bound of the free space, metres."""
        return self.free_space.bounds

    def prepared_space(self) -> Polygon:
        """Return a copy of the free space, prepared for many fast queries; it must not be shared between threads."""
        space = copy.deepcopy(self.free_space)
        shapely.prepare(space)
        return space

    def reachable(self, radius: float, position: Sequence[float] | None = None) -> Polygon:
        """Return the area that the centre of a round robot can reach from `position` (default: the start).

        Raises
        ------
        FloorPlanError
            If the robot does not fit at `position`, if that is in a pocket that it can't leave, or if it can't reach
            nearly all of the building. The message names the place to mend.
        """
        x, y = (self.start if position is None else position)[:2]
        self._check_inside(x, y)
        point = Point(x, y)
        what = f"{self._label}: start ({x:g}, {y:g})"
        parts = [part for part in shapely.get_parts(self.free_space.buffer(-radius)) if not part.is_empty]
        if not parts:
            raise FloorPlanError(
                f"{self._label}: a robot of radius {radius:g} m fits nowhere. If the units are metres, {SMALLER_ROBOT}."
            )
        home = next((part for part in parts if part.covers(point)), None)
        if home is None:
            clearance = self.free_space.boundary.distance(point)
            free = min((nearest_points(part, point)[0] for part in parts), key=point.distance)
            raise FloorPlanError(
                f"{what} is {clearance:.2f} m from a wall, but the robot's radius is {radius:g} m; "
                f"move it off the wall, for example to ({free.x:.1f}, {free.y:.1f}), or {SMALLER_ROBOT}."
            )
        largest = max(parts, key=lambda part: part.area)
        if home is not largest:
            inside = largest.representative_point()
            raise FloorPlanError(
                f"{what} lies in a pocket of {home.area:.1f} m2 that a robot of radius {radius:g} m can't leave; "
                f"start elsewhere, for example at ({inside.x:.1f}, {inside.y:.1f}), or {SMALLER_ROBOT}."
            )
        self._check_passable(home, radius)
        return home

    def unreached(self, home: Polygon, radius: float) -> list[Polygon]:
        """Return the places larger than nooks that a robot with its centre in `home` does not cover."""
        swept = shapely.make_valid(home.buffer(radius * 1.01, join_style="mitre"))  # mitres may cross
        return [part for part in shapely.get_parts(self.free_space.difference(swept)) if part.area > NOOK_AREA]

    def _check_passable(self, home: Polygon, radius: float) -> None:
        """Raise unless a robot whose centre stays in `home` covers nearly all of the building."""
        lost = self.unreached(home, radius)
        if sum(part.area for part in lost) > LOST_SHARE_MAX * self.free_area:
            worst = max(lost, key=lambda part: part.area)
            inside = worst.representative_point()
            raise FloorPlanError(
                f"{self._label}: a corridor is too narrow for a robot of radius {radius:g} m: it can't reach "
                f"{worst.area:.1f} m2 around ({inside.x:.1f}, {inside.y:.1f}); widen the way there, wall it off, as "
                f"an import for this radius does, or {SMALLER_ROBOT}."
            )

    def closed_tour(self) -> float:
        """Return the length of the shortest closed tour that drives every centreline at least once, metres.

        It is NaN where the centrelines are unknown or not all connected. An end within half a corridor's width of
        another centreline is joined to it, and the join is part of the tour.
        """
        from cyclic_env.floor_plans import tour  # imports networkx, which nothing else needs

        return tour.closed_tour(self._corridor_lines(), RESOLUTION)

    def closed_tour_path(self) -> np.ndarray:
        """Return the corners `(n, 2)` of a tour as long as `closed_tour` says, metres; it ends where it begins.

        It is empty where there is no tour.
        """
        from cyclic_env.floor_plans import tour

        return tour.closed_tour_path(self._corridor_lines(), RESOLUTION)

    def _corridor_lines(self) -> list[LineString]:
        """Return the centrelines, and the joins that they lack."""
        from cyclic_env.floor_plans import tour

        lines = [LineString(line) for line in self.centrelines if len(line) > 1]
        return [*lines, *tour.joins(lines, self.free_space.boundary)]


def polygon_from_rings(
    exterior: Sequence[Sequence[float]], holes: Sequence[Sequence[Sequence[float]]] = (), key: str = "exterior"
) -> Polygon:
    """Return the polygon of an outer ring and the rings of its holes, each a list of (x, y).

    Rings may run either way, with or without the first point repeated at the end. Messages call the outer ring `key`.

    Raises
    ------
    FloorPlanError
        If a ring has fewer than three different points, or crosses itself, another ring, or the exterior.
    """
    for label, ring in [(key, exterior), *((f"holes[{i}]", hole) for i, hole in enumerate(holes))]:
        different = len({tuple(point) for point in ring})
        if different < 3:
            raise FloorPlanError(f"{label}: a ring needs at least 3 different points, got {different}.")
        outline = Polygon(ring)
        if not outline.is_valid:
            place = explain_validity(outline)
            raise FloorPlanError(f"{label}: the ring crosses or touches itself ({place}); list its corners in order.")
    polygon = Polygon(exterior, holes)
    if not polygon.is_valid:
        raise FloorPlanError(f"{_misplaced_hole(Polygon(exterior), holes)} ({explain_validity(polygon)}).")
    return polygon


def _misplaced_hole(outer: Polygon, holes: Sequence[Sequence[Sequence[float]]]) -> str:
    """Describe which hole makes the building invalid, and how to mend it."""
    inner = [Polygon(hole) for hole in holes]
    for i, hole in enumerate(inner):
        if not outer.contains(hole) or outer.exterior.intersection(hole.exterior).length > 0:
            return (
                f"holes[{i}]: reaches out of the exterior or lies along it; move it inside or cut it from the exterior"
            )
    for i, hole in enumerate(inner):
        for j, other in enumerate(inner[:i]):
            if hole.intersection(other).length > 0:
                return f"holes[{i}]: overlaps holes[{j}] or has a wall in common with it; merge them into one ring"
    return (
        "holes: they cut the building into parts that touch in points only; leave a corridor between them and the walls"
    )


def polygon_from_corridors(
    corridors: Sequence[tuple[float, Sequence[Sequence[float]]]],
    rooms: Sequence[Sequence[Sequence[float]]] = (),
) -> Polygon:
    """Return the free space of corridors, given by width and centreline, and of rooms, given as rings.

    A centreline whose ends meet is a closed loop. Any other corridor extends half its width beyond the ends of its
    centreline, so that corridors that share an end make a full corner.

    Raises
    ------
    FloorPlanError
        If a centreline has fewer than two points or no length, or the parts are not all connected.
    """
    parts: list[shapely.Geometry] = []
    for i, (width, line) in enumerate(corridors):
        if len(line) < 2 or all(tuple(point) == tuple(line[0]) for point in line):
            raise FloorPlanError(f"corridors[{i}].line: a centreline needs at least 2 different points.")
        closed = len(line) > 3 and tuple(line[0]) == tuple(line[-1])
        geometry = LinearRing(line) if closed else LineString(line)
        parts.append(geometry.buffer(width / 2, cap_style="square", join_style="mitre"))
    parts.extend(polygon_from_rings(room, key=f"rooms[{i}]") for i, room in enumerate(rooms))
    union = shapely.set_precision(shapely.union_all(parts), RESOLUTION).simplify(RESOLUTION)
    if union.is_empty:
        raise FloorPlanError("the corridors and rooms have no area; are their widths in metres?")
    if not isinstance(union, Polygon):
        where = ", ".join(f"({p.centroid.x:.1f}, {p.centroid.y:.1f})" for p in shapely.get_parts(union)[:4])
        raise FloorPlanError(
            f"the corridors and rooms are not connected: separate parts around {where}; join them by a corridor."
        )
    return union
