"""The scene: the fixed parts of a building's picture, made once and shared by all renderers.

It holds the positions of the building and of the robot's close-up, the walls, the title and the legend.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import shapely

from cyclic_env.floor_plans import FloorPlan, PlanPool
from cyclic_env.rendering.colors import BEAM, FAINT, INK, PAPER, PATH_NEW, RULE, SEEN, SOLID, WALL
from cyclic_env.rendering.primitives import (
    LABEL_SIZE,
    MARK,
    TITLE_SIZE,
    View,
    blit_centered,
    cross_mark,
    draw_scale_bar,
    pygame,
    render_text,
    shorten,
    start_mark,
    swatch,
    tick_mark,
    transparent_surface,
    write,
)

SIZE_MAX = (1200, 900)
"""Greatest width and height of a picture, pixels."""
WIDTH_MIN = 800
"""The line of scores needs this width."""
HEADER, FOOTER, MARGIN = 66, 34, 16
TITLE_LINE, SCORE_LINE = 20, 47
"""Pixel rows of the centres of the two lines above the building."""
SCALE_MAX = 40.0
"""Pixels per metre; the limit keeps a single room from filling a screen."""
STATIC_ZOOM = 3
"""How many times larger the building is drawn before it is scaled down, which smooths its edges."""

INSET_SCALE_MAX = 12.0
"""Pixels per metre. Where the building is drawn smaller, a close-up of the robot is added."""
INSET_SIZE = 300
"""Side of the close-up, pixels."""
INSET_CLEARANCE = 10
"""Pixels between the close-up and the corridors, where it lies inside the building."""
INSET_GRID = 8
"""Pixels between the candidate positions of the close-up."""
INSET_WALL = 0.1
"""Thickness of the walls in the close-up, metres."""


@dataclass(frozen=True, slots=True)
class Scene:
    """The fixed parts of a building's picture of a given size.

    Attributes
    ----------
    size : (width, height)
    view : View
    inset : Rect or None
        Where the close-up of the robot is; None if the building is drawn large enough.
    overlay : Surface
        What is drawn over the tint of the seen cells: walls and everything behind them. Free space is transparent.
    free, walled : shapely geometry
        The free space, and the free space with the close-up's walls.
    """

    size: tuple[int, int]
    view: View
    inset: pygame.Rect | None
    overlay: pygame.Surface
    free: shapely.Polygon
    walled: shapely.Geometry


@lru_cache(maxsize=64)
def canvas_size(plans: PlanPool) -> tuple[int, int]:
    """Return the width and height, both even, of a picture that suits all plans of a pool.

    It is `SIZE_MAX` while some plans of the pool haven't been loaded.
    """
    if len(plans.loaded) < len(plans):
        return SIZE_MAX
    room = pygame.Rect(MARGIN, HEADER + MARGIN, SIZE_MAX[0] - 2 * MARGIN, SIZE_MAX[1] - HEADER - FOOTER - 2 * MARGIN)
    rights, bottoms = [WIDTH_MIN - MARGIN], [0]
    for plan in plans:
        view, inset = _arrange(plan, room, snug=True)
        _, south, east, _ = plan.bounds
        right, bottom = view.pixels((east, south))
        rights.append(math.ceil(right))
        bottoms.append(math.ceil(bottom))
        if inset is not None:
            rights.append(inset.right)
            bottoms.append(inset.bottom)
    width, height = max(rights) + MARGIN, max(bottoms) + MARGIN + FOOTER
    return min(width + width % 2, SIZE_MAX[0]), min(height + height % 2, SIZE_MAX[1])


@lru_cache(maxsize=16)
def scene_of(plan: FloorPlan, size: tuple[int, int]) -> Scene:
    """Return the scene of a plan in pictures of the given size."""
    room = pygame.Rect(MARGIN, HEADER + MARGIN, size[0] - 2 * MARGIN, size[1] - HEADER - FOOTER - 2 * MARGIN)
    view, inset = _arrange(plan, room, snug=False)
    thickness = max(1.6 / view.scale, 0.08)
    large = draw_building(
        (size[0] * STATIC_ZOOM, size[1] * STATIC_ZOOM),
        view.zoomed(STATIC_ZOOM),
        plan.free_space,
        plan.free_space.buffer(thickness, join_style="mitre"),
    )
    overlay = pygame.transform.smoothscale(large, size)
    opacity = pygame.surfarray.pixels_alpha(overlay)
    opacity[opacity > 250] = 255  # smoothing rounds down, which would let the tint show through
    del opacity  # the array locks the surface
    overlay.fill(PAPER, (0, 0, size[0], HEADER))
    overlay.fill(PAPER, (0, size[1] - FOOTER, size[0], FOOTER))
    overlay.fill(RULE, (0, HEADER - 1, size[0], 1))
    overlay.fill(RULE, (0, size[1] - FOOTER, size[0], 1))
    _draw_title(overlay, plan)
    _draw_legend(overlay, view)
    walled = plan.free_space.buffer(INSET_WALL, join_style="mitre")
    return Scene(size, view, inset, overlay, plan.free_space, walled)


def _arrange(plan: FloorPlan, room: pygame.Rect, *, snug: bool) -> tuple[View, pygame.Rect | None]:
    """Return the view of a plan centred in a room, or in its corner (`snug`), and where the close-up goes."""
    view = _fit(plan, room, snug=snug)
    if view.scale >= INSET_SCALE_MAX:
        return view, None
    inset = _free_inset(plan, view, room)
    if inset is not None:
        return view, inset
    left = pygame.Rect(room.left, room.top, room.width - INSET_SIZE - MARGIN, room.height)
    view = _fit(plan, left, snug=snug)
    beside = view.pixels((plan.bounds[2], 0.0))[0] if snug else left.right
    return view, pygame.Rect(math.ceil(beside) + MARGIN, room.top, INSET_SIZE, INSET_SIZE)


def _fit(plan: FloorPlan, room: pygame.Rect, *, snug: bool) -> View:
    west, south, east, north = plan.bounds
    scale = min(SCALE_MAX, room.width / (east - west), room.height / (north - south))
    spare_x, spare_y = room.width - scale * (east - west), room.height - scale * (north - south)
    share = 0.0 if snug else 0.5
    return View(west, north, scale, room.left + share * spare_x, room.top + share * spare_y)


def _free_inset(plan: FloorPlan, view: View, room: pygame.Rect) -> pygame.Rect | None:
    """Return where the close-up covers no free space, as near to a corner of the building as possible, if anywhere."""
    west, south, east, north = plan.bounds
    left, top = view.pixels((west, north))
    right, bottom = view.pixels((east, south))
    right, bottom = min(right, room.right) - INSET_SIZE, min(bottom, room.bottom) - INSET_SIZE
    if right < left or bottom < top:
        return None
    columns, rows = np.meshgrid(
        np.append(np.arange(left, right, INSET_GRID), right), np.append(np.arange(top, bottom, INSET_GRID), bottom)
    )
    pad = INSET_CLEARANCE / view.scale
    side = INSET_SIZE / view.scale
    wests, norths = view.west + (columns - view.left) / view.scale, view.north - (rows - view.top) / view.scale
    boxes = shapely.box(wests - pad, norths - side - pad, wests + side + pad, norths + pad)
    free = ~shapely.intersects(plan.prepared_space(), boxes)
    if not free.any():
        return None
    to_corner = np.minimum(columns - left, right - columns) + np.minimum(rows - top, bottom - rows)
    best = np.argmin(np.where(free, to_corner, np.inf))
    return pygame.Rect(round(columns.flat[best]), round(rows.flat[best]), INSET_SIZE, INSET_SIZE)


def draw_building(
    size: tuple[int, int], view: View, free: shapely.Geometry, walled: shapely.Geometry
) -> pygame.Surface:
    """Return the walls and everything behind them, with transparent free space; `walled` is free space plus walls."""
    surface = transparent_surface(size)
    surface.fill(SOLID)
    # Transparent pixels have the walls' colour, so that smoothed edges contain no other colour.
    layers = [(walled, "exterior", WALL), (free, "exterior", (*WALL, 0)), (free, "interiors", WALL)]
    for geometry, rings, color in [*layers, (walled, "interiors", SOLID)]:
        for polygon in shapely.get_parts(geometry):
            if isinstance(polygon, shapely.Polygon) and not polygon.is_empty:
                for ring in [polygon.exterior] if rings == "exterior" else polygon.interiors:
                    pygame.draw.polygon(surface, color, view.pixels(ring.coords))
    return surface


def _draw_title(overlay: pygame.Surface, plan: FloorPlan) -> None:
    """Draw the plan's title; what follows a colon in it is drawn as a remark."""
    name, _, remark = (plan.title or plan.name).partition(": ")
    end = overlay.get_width() - MARGIN
    x = write(overlay, shorten(name, TITLE_SIZE, end - MARGIN), TITLE_SIZE, INK, MARGIN, TITLE_LINE) + 10
    write(overlay, shorten(remark, LABEL_SIZE, end - x), LABEL_SIZE, FAINT, x, TITLE_LINE + 2)


def _draw_legend(overlay: pygame.Surface, view: View) -> None:
    """Draw the scale bar and the legend of the marks."""
    y = overlay.get_height() - FOOTER // 2
    longest = 120 / view.scale
    magnitude = 10.0 ** math.floor(math.log10(longest))
    metres = max(step * magnitude for step in (1, 2, 5) if step * magnitude <= longest)
    draw_scale_bar(overlay, MARGIN, y + 5, view.scale, metres)
    x = overlay.get_width() - MARGIN
    marks = [
        ("false claim", cross_mark(MARK)),
        ("closes a cycle", tick_mark(MARK + 2)),
        ("correct claim", tick_mark(MARK)),
        ("laser", swatch(BEAM)),
        ("seen", swatch(SEEN)),
        ("path", swatch(PATH_NEW, 3)),
        ("start", start_mark(MARK)),
    ]
    for label, sprite in marks:
        x -= render_text(label, LABEL_SIZE, FAINT).get_width()
        write(overlay, label, LABEL_SIZE, FAINT, x, y)
        x -= 14
        blit_centered(overlay, sprite, x, y)
        x -= 28
