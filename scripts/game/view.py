"""What the player sees: the building and the truth, or what the robot has sensed; and the keys."""

from __future__ import annotations

import math

import numpy as np

from cyclic_env.rendering.colors import AMBER, BEAM, FAINT, FLOOR, INK, PAPER, PATH_NEW, RULE, WALL, Colour
from cyclic_env.rendering.primitives import (
    LABEL_SIZE,
    MARK,
    TEXT_SIZE,
    View,
    blit_middle,
    draw_line,
    draw_scale_bar,
    opaque_surface,
    pygame,
    ring_mark,
    robot_mark,
    shortened,
    start_mark,
    write,
)
from cyclic_env.rendering.renderer import ROBOT_RADIUS_MIN, draw_picture
from cyclic_env.rendering.scene import MARGIN, canvas_size, scene_of
from scripts.game.game import Play

STRIP = 54
"""Pixel rows below the picture, for the message and the keys."""
ROBOT_SIZE = (1000, 700)
"""Of the picture of what the robot has sensed."""
ROBOT_SCALE_MAX = 24.0
"""Pixels a metre in it at most."""
KEYS = (
    "arrows or WASD: drive     Shift: slowly     Space: claim     click: pick a place (right click: the nearest)"
    "     P: pause     R: again     Esc: end"
)


def play_size(play: Play) -> tuple[int, int]:
    """Return the width and height of the pictures of a play."""
    width, height = canvas_size(play.core.floor_plans) if play.show == "truth" else ROBOT_SIZE
    return width, height + STRIP


def play_view(play: Play) -> View:
    """Return where the world is in the picture."""
    width, height = play_size(play)
    if play.show == "truth":
        return scene_of(play.core.floor_plan, (width, height - STRIP)).view
    reach = play.core.config.laser.range_max
    around = [play.positions, play.positions[-1:] - reach, play.positions[-1:] + reach, play.cloud]
    points = np.concatenate(around)
    (west, south), (east, north) = points.min(axis=0), points.max(axis=0)
    room = (width - 2 * MARGIN, height - STRIP - 2 * MARGIN)
    scale = min(ROBOT_SCALE_MAX, room[0] / (east - west), room[1] / (north - south))
    left, top = (room[0] - scale * (east - west)) / 2, (room[1] - scale * (north - south)) / 2
    return View(west, north, scale, MARGIN + left, MARGIN + top)


def draw_play(play: Play) -> pygame.Surface:
    """Return the picture of a play as it is now."""
    picture = opaque_surface(play_size(play))
    picture.fill(PAPER)
    view = play_view(play)
    if play.show == "truth":
        picture.blit(draw_picture(play.core.engine, 0), (0, 0))
    else:
        _draw_sensed(picture, view, play)
    place = play.candidate()
    if place is not None and not play.ended:
        here, there = view.pixels([play.pose[:2], play.positions[place]])
        if math.hypot(*(here - there)) > MARK:
            draw_line(picture, AMBER, np.array([here, there]), 1, smooth=True)
        blit_middle(picture, ring_mark(AMBER, MARK), *there)
    _draw_strip(picture, play, place)
    return picture


def _draw_sensed(picture: pygame.Surface, view: View, play: Play) -> None:
    """Draw the ends of the beams so far and of the last scan, the way, and the robot, all by dead reckoning."""
    picture.fill(FLOOR, (0, 0, picture.get_width(), picture.get_height() - STRIP))
    dot = max(1, round(view.scale * 0.12))
    for points, colour, side in ((play.cloud, WALL, dot), (play.hits, BEAM, dot + 2)):
        _draw_dots(picture, view.pixels(points), colour, side)
    way = view.pixels(play.positions)
    if len(way) > 1:
        draw_line(picture, PATH_NEW, way, 2, smooth=False)
    blit_middle(picture, start_mark(MARK), *way[0])
    radius = max(ROBOT_RADIUS_MIN, play.core.config.robot.radius * view.scale)
    blit_middle(picture, robot_mark(radius, float(play.pose[2])), *way[-1])
    metres = next(step for step in (5.0, 10.0, 20.0, 50.0, 100.0, 1e3) if step * view.scale > 60)
    draw_scale_bar(picture, MARGIN, picture.get_height() - STRIP - MARGIN, view.scale, metres)


def _draw_dots(picture: pygame.Surface, places: np.ndarray, colour: Colour, side: int) -> None:
    """Draw squares of so many pixels; the many that they are, all at once."""
    pixels = pygame.surfarray.pixels2d(picture)
    corners = np.round(places).astype(int) - side // 2
    inside = ((corners >= 0) & (corners < np.array(pixels.shape) - side)).all(axis=1)
    columns, rows = corners[inside].T
    for i in range(side):
        for j in range(side):
            pixels[columns + i, rows + j] = picture.map_rgb(colour)


def _draw_strip(picture: pygame.Surface, play: Play, place: int | None) -> None:
    width, height = picture.get_size()
    picture.fill(PAPER, (0, height - STRIP, width, STRIP))
    picture.fill(RULE, (0, height - STRIP, width, 1))
    state = "ended" if play.ended else "paused" if play.paused else f"step {play.steps:,}"
    x = write(picture, state, TEXT_SIZE, INK, MARGIN, height - STRIP + 17) + 18
    if place is not None and not play.ended:
        driven = play.way[:, 3]
        away = math.hypot(*(play.positions[place] - play.pose[:2]))
        told = f"Space says: here was step {place:,}, {driven[-1] - driven[place]:,.0f} m ago, {away:.1f} m off"
        x = write(picture, told, TEXT_SIZE, INK, x, height - STRIP + 17) + 18
    message = shortened(play.message, TEXT_SIZE, width - MARGIN - x)
    write(picture, message, TEXT_SIZE, PATH_NEW, x, height - STRIP + 17)
    write(picture, shortened(KEYS, LABEL_SIZE, width - 2 * MARGIN), LABEL_SIZE, FAINT, MARGIN, height - STRIP + 39)
