"""The picture of a robot: the building, what has been seen, its path, beams, claims and scores.

Pictures are drawn off screen and need no display. A picture depends on nothing but the state of the episode: it is the
same whether or not earlier ones were drawn. The fixed parts of a building's picture are in its `Scene`.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import TYPE_CHECKING, Protocol

import numpy as np
import shapely

from cyclic_env.rendering.colors import AMBER, BEAM, FAINT, FLOOR, INK, PATH_NEW, PATH_OLD, RIGHT, SEEN, WRONG
from cyclic_env.rendering.primitives import (
    LABEL_SIZE,
    MARK,
    TEXT_SIZE,
    View,
    blit_centered,
    cross_mark,
    draw_line,
    draw_scale_bar,
    mix,
    opaque_surface,
    pygame,
    ring_mark,
    robot_mark,
    start_mark,
    tick_mark,
    transparent_surface,
    write,
)
from cyclic_env.rendering.scene import MARGIN, SCORE_LINE, Scene, canvas_size, draw_building, scene_of
from cyclic_env.rendering.snapshot import RobotSnapshot
from cyclic_env.rendering.window import Window

if TYPE_CHECKING:
    from cyclic_env.engine.engine import Engine

PATH_SPACING = 4.0
"""Pixels between the drawn points of the path."""
PATH_SHADES = 24
PATH_WIDTH = 2
FAN_ALPHA = 80
ROBOT_RADIUS_MIN = 8.0
"""Pixels. In a large building the robot is drawn larger than it is."""
INSET_REACH = 6.5
"""Metres from the centre of the close-up to its sides."""
INSET_ZOOM = 2
"""How many times larger the close-up is drawn before it is scaled down, which smooths its edges."""


class DrawableEnv(Protocol):
    """A `CyclicLoopEnv` or a `CyclicLoopVectorEnv`, which this module can't import."""

    engine: Engine


class Renderer:
    """Draws one robot of an environment.

    Parameters
    ----------
    render_mode : {"rgb_array", "human"}
        ``"rgb_array"`` returns arrays and needs no display. ``"human"`` shows a window. When the user closes it, the
        run goes on without pictures.
    fps : int
        Frames per second of the window; `draw` waits accordingly.

    Raises
    ------
    ConfigError
        If there is no display for a window.
    """

    def __init__(self, render_mode: str, fps: int) -> None:
        self.render_mode = render_mode
        self._fps = fps
        self._window: Window | None = None

    def draw(self, env: DrawableEnv, row: int = 0) -> np.ndarray | None:
        """Draw a robot's building, path and claims as they are now.

        Parameters
        ----------
        env : CyclicLoopEnv or CyclicLoopVectorEnv
        row : int
            The robot; its episode must have begun.

        Returns
        -------
        A new (height, width, 3) uint8 array, or None with ``"human"``. Height and width are even, as video codecs
        require, and the same for all plans of the environment's pool.
        """
        if self.render_mode == "rgb_array":
            picture = draw_picture(env, row)
            columns = pygame.surfarray.pixels3d(picture)
            frame = np.empty((columns.shape[1], columns.shape[0], 3), np.uint8)
            for channel in range(3):  # one channel at a time is many times faster than all at once
                frame[..., channel] = columns[..., channel].T
            return frame
        if self._window is None:
            hint = 'leave out --human, or use render_mode="rgb_array", which needs none.'
            self._window = Window(canvas_size(env.engine.plans), self._fps, hint)
        if self._window.is_open():
            self._window.show(draw_picture(env, row))
        return None

    def close(self) -> None:
        """Close the window, if there is one; the next picture opens a new one."""
        if self._window is not None:
            self._window.close()
            self._window = None


def draw_picture(env: DrawableEnv, row: int = 0) -> pygame.Surface:
    """Return the picture of a robot: opaque, 32 bits per pixel."""
    engine = env.engine
    scene = scene_of(engine.plan(row), canvas_size(engine.plans))
    snapshot = RobotSnapshot.of(engine, row)
    picture = opaque_surface(scene.size)
    _draw_layers(picture, scene.view, scene.overlay, snapshot, 1)
    if scene.inset is not None:
        x, y = scene.view.pixels(snapshot.pose[:2])
        reach = INSET_REACH * scene.view.scale
        pygame.draw.rect(picture, INK, (round(x - reach), round(y - reach), round(2 * reach), round(2 * reach)), 1)
        _draw_inset(picture, scene, scene.inset, snapshot)
    _draw_scores(picture, engine, row)
    return picture


def _draw_layers(
    picture: pygame.Surface, view: View, overlay: pygame.Surface, snapshot: RobotSnapshot, zoom: int
) -> None:
    """Draw the building and everything in it; the picture is `zoom` times larger than it will be shown."""
    picture.fill(FLOOR)
    _draw_seen(picture, view, snapshot)
    picture.blit(overlay, (0, 0))
    _draw_beams(picture, view, snapshot, zoom)
    _draw_path(picture, view, snapshot, zoom)
    _draw_claims(picture, view, snapshot, zoom)
    blit_centered(picture, start_mark(MARK * zoom), *view.pixels(snapshot.track[0, :2]))
    radius = max(ROBOT_RADIUS_MIN * zoom, snapshot.radius * view.scale)
    position = view.pixels(snapshot.pose[:2])
    blit_centered(picture, robot_mark(radius, snapshot.pose[2]), *position)
    if len(snapshot.claims) and snapshot.claims["step"][-1] == len(snapshot.track) - 1:
        blit_centered(picture, _claim_mark(snapshot.claims[-1], zoom), *position)


def _claim_mark(claim: np.void, zoom: int) -> pygame.Surface:
    if not claim["correct"]:
        return cross_mark(MARK * zoom)
    return tick_mark((MARK + 2 if claim["new_cycle"] else MARK) * zoom)


def _draw_seen(picture: pygame.Surface, view: View, snapshot: RobotSnapshot) -> None:
    """Tint the cells that have been seen, including parts behind walls: the building is drawn over them."""
    size = snapshot.cell_size
    # Crop the grid to the picture, plus one cell on each side.
    left, bottom = view.west - view.left / view.scale, view.north - (picture.get_height() - view.top) / view.scale
    right, top = left + picture.get_width() / view.scale, bottom + picture.get_height() / view.scale
    first_column = max(0, math.floor((left - snapshot.west) / size) - 1)
    first_row = max(0, math.floor((bottom - snapshot.south) / size) - 1)
    part = snapshot.seen[
        first_row : max(0, math.ceil((top - snapshot.south) / size) + 1),
        first_column : max(0, math.ceil((right - snapshot.west) / size) + 1),
    ]
    if part.size == 0:
        return
    seen = _with_wall_cells(part)
    # Where a cell covers many pixels, its edges are smoothed. The cells are enlarged first, because smoothscale shifts
    # the picture by up to half an input pixel.
    smooth = size * view.scale > 4
    repeat = max(1, round(size * view.scale / 5)) if smooth else 1
    shown = np.repeat(np.repeat(seen[::-1], repeat, axis=0), repeat, axis=1)
    red, green, blue = SEEN
    tint = np.where(shown, np.uint32(0xFF000000), np.uint32(0)) | np.uint32(red << 16 | green << 8 | blue)
    cells = pygame.image.frombuffer(tint.astype("<u4").tobytes(), tint.shape[::-1], "BGRA")  # a surface's own layout
    west, south = snapshot.west + first_column * size, snapshot.south + first_row * size
    corners = view.pixels([(west, south + part.shape[0] * size), (west + part.shape[1] * size, south)])
    (left, top), (right, bottom) = np.round(corners).astype(int).tolist()
    resize = pygame.transform.smoothscale if smooth else pygame.transform.scale
    picture.blit(resize(cells, (right - left, bottom - top)), (left, top))


def _with_wall_cells(cells: np.ndarray) -> np.ndarray:
    """Return the cells to tint: those seen, and their neighbours in walls, which may have a strip of floor."""
    seen = cells == 1
    near = seen.copy()
    near[1:] |= seen[:-1]
    near[:-1] |= seen[1:]
    beside = near.copy()
    near[:, 1:] |= beside[:, :-1]
    near[:, :-1] |= beside[:, 1:]
    return seen | (near & (cells < 0))


def _draw_path(picture: pygame.Surface, view: View, snapshot: RobotSnapshot, zoom: int) -> None:
    """Draw the path so far; older parts are paler."""
    passed = np.floor(snapshot.track[:, 2] * view.scale / (PATH_SPACING * zoom))
    steps = np.append(np.flatnonzero(np.diff(passed, prepend=-1.0)), len(snapshot.track) - 1)
    points = view.pixels(snapshot.track[steps, :2])
    near = ((points > -8 * zoom) & (points < np.array(picture.get_size()) + 8 * zoom)).all(axis=1)
    inside, shades = near.astype(int), np.arange(len(points)) * PATH_SHADES // len(points)
    breaks = np.flatnonzero(np.diff(shades) | np.diff(inside)) + 1
    for first, last in pairwise([0, *breaks.tolist(), len(points) - 1]):
        if last > first and (inside[first] or inside[last]):
            color = mix(PATH_OLD, PATH_NEW, shades[first] / (PATH_SHADES - 1))
            draw_line(picture, color, points[first : last + 1], PATH_WIDTH * zoom, smooth=zoom == 1)


def _draw_beams(picture: pygame.Surface, view: View, snapshot: RobotSnapshot, zoom: int) -> None:
    """Draw the last scan as a fan, with a dot where a beam hit something."""
    endpoints = view.pixels(snapshot.hits_world)
    outline = endpoints if snapshot.sees_all_around else np.vstack([endpoints, view.pixels(snapshot.pose[:2])])
    low = np.maximum(np.floor(outline.min(axis=0)) - 1, 0)
    high = np.minimum(np.ceil(outline.max(axis=0)) + 2, picture.get_size())
    layer = transparent_surface((int(high[0] - low[0]), int(high[1] - low[1])))
    layer.fill((*BEAM, 0))
    pygame.draw.polygon(layer, (*BEAM, FAN_ALPHA), outline - low)
    if zoom > 1:
        x, y = view.pixels(snapshot.pose[:2]) - low
        for endpoint in endpoints - low:
            pygame.draw.line(layer, (*BEAM, 2 * FAN_ALPHA), (x, y), endpoint)
    picture.blit(layer, low)
    for x, y in np.round(endpoints[snapshot.is_hit]).astype(int).tolist():
        picture.fill(AMBER, (x - zoom, y - zoom, 2 * zoom, 2 * zoom))


def _draw_claims(picture: pygame.Surface, view: View, snapshot: RobotSnapshot, zoom: int) -> None:
    """Draw each judged claim: a mark where it was made, and a line to the position that it named."""
    # False claims come last: they are fewer and must not be hidden.
    claims = snapshot.claims[np.argsort(~snapshot.claims["correct"], kind="stable")]
    made = view.pixels(snapshot.track[claims["step"], :2])
    named = view.pixels(snapshot.track[np.maximum(claims["match"], 0), :2])
    low, high = np.minimum(made, named), np.maximum(made, named)
    near = ((high > -MARK * zoom) & (low < np.array(picture.get_size()) + MARK * zoom)).all(axis=1)
    visible = np.hypot(*(named - made).T) > MARK * zoom  # a shorter line is hidden by the mark
    for i in np.flatnonzero(near & visible & (claims["match"] >= 0)).tolist():
        color = RIGHT if claims["correct"][i] else WRONG
        draw_line(picture, color, np.array([made[i], named[i]]), 2 * zoom, smooth=zoom == 1)
        blit_centered(picture, ring_mark(color, 4 * zoom), *named[i])
    for i in np.flatnonzero(near).tolist():
        blit_centered(picture, _claim_mark(claims[i], zoom), *made[i])


def _draw_inset(picture: pygame.Surface, scene: Scene, inset: pygame.Rect, snapshot: RobotSnapshot) -> None:
    """Draw a close-up of the robot and its surroundings."""
    x, y, _ = snapshot.pose
    side = inset.width * INSET_ZOOM
    view = View(x - INSET_REACH, y + INSET_REACH, side / (2 * INSET_REACH))
    close_up = opaque_surface((side, side))
    reach = INSET_REACH + 1  # keeps the cut edges outside the close-up
    window = (x - reach, y - reach, x + reach, y + reach)
    free, walled = (shapely.clip_by_rect(geometry, *window) for geometry in (scene.free, scene.walled))
    _draw_layers(close_up, view, draw_building((side, side), view, free, walled), snapshot, INSET_ZOOM)
    picture.blit(pygame.transform.smoothscale(close_up, inset.size), inset)
    draw_scale_bar(picture, inset.left + 10, inset.bottom - 10, view.scale / INSET_ZOOM, 2.0)
    pygame.draw.rect(picture, INK, inset.inflate(2, 2), 1)


def _draw_scores(picture: pygame.Surface, engine: Engine, row: int) -> None:
    """Draw the line of scores."""
    info = engine.info[row]
    steps = int(engine.steps[row])
    correct = int(info["claims"] - info["false_claims"])
    scores = [
        ("step", f"{steps:,} / {engine.step_budget(row):,}", 0.0),
        ("seen", f"{100 * info['coverage']:.1f} %", 0.215),
        ("cycles", f"{info['cycles_closed']} / {info['cycles_total']}", 0.35),
        ("claims", "", 0.475),
        ("revisits", f"{info['revisits_recognised']} / {info['revisits']}", 0.685),
        ("return", f"{engine.outcome[row]['episode_return']:.1f}", 0.855),
    ]
    width = picture.get_width() - 2 * MARGIN
    for label, value, share in scores:
        x = write(picture, label, LABEL_SIZE, FAINT, MARGIN + round(share * width), SCORE_LINE) + 7
        if label == "claims":
            for sprite, count in ((tick_mark(MARK), correct), (cross_mark(MARK), int(info["false_claims"]))):
                blit_centered(picture, sprite, x + 7, SCORE_LINE)
                x = write(picture, str(count), TEXT_SIZE, INK, x + 19, SCORE_LINE) + 10
        else:
            write(picture, value, TEXT_SIZE, INK, x, SCORE_LINE)
