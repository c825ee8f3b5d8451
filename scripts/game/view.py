"""The picture of a game: the building and the truth, or what the robot has sensed, above a line with the keys."""

from __future__ import annotations

import math

import numpy as np

from cyclic_env.rendering.colors import AMBER, BEAM, FAINT, FLOOR, INK, PAPER, PATH_NEW, RULE, WALL, Color
from cyclic_env.rendering.primitives import (
    LABEL_SIZE,
    MARK,
    TEXT_SIZE,
    View,
    blit_centered,
    draw_line,
    draw_scale_bar,
    opaque_surface,
    pygame,
    ring_mark,
    robot_mark,
    shorten,
    start_mark,
    write,
)
from cyclic_env.rendering.renderer import ROBOT_RADIUS_MIN, draw_picture
from cyclic_env.rendering.scene import MARGIN, canvas_size, scene_of
from scripts.game.game import Play

STRIP = 54
"""Height of the strip below the picture, for the message and the keys, pixels."""
ROBOT_SIZE = (1000, 700)
"""Width and height of the picture of what the robot has sensed."""
ROBOT_SCALE_MAX = 24.0
"""Greatest scale of this picture, pixels per metre."""
KEYS = (
    "arrows or WASD: drive     Shift: slowly     Space: claim     click: pick a place (right click: the nearest)"
    "     P: pause     R: restart     Esc: quit"
)


def play_size(play: Play) -> tuple[int, int]:
    """Return the width and height of a game's pictures."""
    width, height = canvas_size(play.core.floor_plans) if play.show == "truth" else ROBOT_SIZE
    return width, height + STRIP


def play_view(play: Play) -> View:
    """Return the view of the world in the picture."""
    width, height = play_size(play)
    if play.show == "truth":
        return scene_of(play.core.floor_plan, (width, height - STRIP)).view
    reach = play.core.config.laser.range_max
    points = np.concatenate([play.positions, play.positions[-1:] - reach, play.positions[-1:] + reach, play.cloud])
    (west, south), (east, north) = points.min(axis=0), points.max(axis=0)
    room = (width - 2 * MARGIN, height - STRIP - 2 * MARGIN)
    scale = min(ROBOT_SCALE_MAX, room[0] / (east - west), room[1] / (north - south))
    left, top = (room[0] - scale * (east - west)) / 2, (room[1] - scale * (north - south)) / 2
    return View(west, north, scale, MARGIN + left, MARGIN + top)


def draw_play(play: Play) -> pygame.Surface:
    """Return the picture of a game as it is now."""
    picture = opaque_surface(play_size(play))
    picture.fill(PAPER)
    view = play_view(play)
    if play.show == "truth":
        picture.blit(draw_picture(play.core), (0, 0))
    else:
        _draw_sensed(picture, view, play)
    step = play.candidate()
    if step is not None and not play.ended:
        here, there = view.pixels([play.pose[:2], play.positions[step]])
        if math.hypot(*(here - there)) > MARK:
            draw_line(picture, AMBER, np.array([here, there]), 1, smooth=True)
        blit_centered(picture, ring_mark(AMBER, MARK), *there)
    _draw_strip(picture, play, step)
    return picture


def _draw_sensed(picture: pygame.Surface, view: View, play: Play) -> None:
    """Draw the endpoints of the beams so far and of the last scan, the path and the robot, all by dead reckoning."""
    picture.fill(FLOOR, (0, 0, picture.get_width(), picture.get_height() - STRIP))
    dot = max(1, round(view.scale * 0.12))
    for points, color, side in ((play.cloud, WALL, dot), (play.hits, BEAM, dot + 2)):
        _draw_dots(picture, view.pixels(points), color, side)
    path = view.pixels(play.positions)
    if len(path) > 1:
        draw_line(picture, PATH_NEW, path, 2, smooth=False)
    blit_centered(picture, start_mark(MARK), *path[0])
    radius = max(ROBOT_RADIUS_MIN, play.core.config.robot.radius * view.scale)
    blit_centered(picture, robot_mark(radius, float(play.pose[2])), *path[-1])
    metres = next(step for step in (5.0, 10.0, 20.0, 50.0, 100.0, 1e3) if step * view.scale > 60)
    draw_scale_bar(picture, MARGIN, picture.get_height() - STRIP - MARGIN, view.scale, metres)


def _draw_dots(picture: pygame.Surface, centers: np.ndarray, color: Color, side: int) -> None:
    """Draw many squares of `side` pixels at once."""
    pixels = pygame.surfarray.pixels2d(picture)
    corners = np.round(centers).astype(int) - side // 2
    inside = ((corners >= 0) & (corners < np.array(pixels.shape) - side)).all(axis=1)
    columns, rows = corners[inside].T
    for i in range(side):
        for j in range(side):
            pixels[columns + i, rows + j] = picture.map_rgb(color)


def _draw_strip(picture: pygame.Surface, play: Play, step: int | None) -> None:
    width, height = picture.get_size()
    picture.fill(PAPER, (0, height - STRIP, width, STRIP))
    picture.fill(RULE, (0, height - STRIP, width, 1))
    middle = height - STRIP + 17
    state = "ended" if play.ended else "paused" if play.paused else "" if play.started else "ready"
    if play.show == "robot":  # the other picture has a line of scores
        cycles = f"cycles closed {play.info['cycles_closed']} / {play.info['cycles_total']}"
        state = "     ".join(filter(None, (f"step {play.steps:,} / {play.core.step_budget:,}", cycles, state)))
    x = write(picture, state, TEXT_SIZE, INK, MARGIN, middle) + 18 if state else MARGIN
    if step is not None and not play.ended:
        driven = play.track[:, 3]
        distance = math.hypot(*(play.positions[step] - play.pose[:2]))
        claim = f"Space: I was here at step {step:,}, {driven[-1] - driven[step]:,.0f} m ago ({distance:.1f} m away)"
        x = write(picture, claim, TEXT_SIZE, INK, x, middle) + 18
    write(picture, shorten(play.message, TEXT_SIZE, width - MARGIN - x), TEXT_SIZE, PATH_NEW, x, middle)
    write(picture, shorten(KEYS, LABEL_SIZE, width - 2 * MARGIN), LABEL_SIZE, FAINT, MARGIN, height - STRIP + 39)
