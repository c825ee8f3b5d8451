"""State to picture: the building, what has been seen, the robot's way, its beams, its claims and its scores.

Pictures are drawn off screen and need no display; a window only shows them. A picture depends on the state of
the episode and on nothing else, least of all on which pictures came before. What never changes about a building
(where it is in the picture, its walls) is a `Scene`, made once and shared by all renderers of the process.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely

from cyclic_env.errors import ConfigError
from cyclic_env.rendering.colors import AMBER, BEAM, FAINT, FLOOR, INK, PATH_NEW, PATH_OLD, RIGHT, SEEN, WRONG
from cyclic_env.rendering.primitives import (
    LABEL_SIZE,
    MARK,
    TEXT_SIZE,
    View,
    blit_middle,
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
from cyclic_env.validation import unknown_name

if TYPE_CHECKING:
    from cyclic_env.engine.engine import Engine

RENDER_MODES = ("human", "rgb_array")

PATH_GRAIN = 4.0
"""Pixels between the points of the drawn path."""
PATH_SHADES = 24
PATH_WIDTH = 2
FAN_ALPHA = 80
ROBOT_RADIUS_MIN = 8.0
"""Pixels; in a large building the robot is drawn larger than it is."""
INSET_REACH = 6.5
"""Metres from the middle of the close-up to its side."""
INSET_ZOOM = 2
"""How many times larger the close-up is drawn before it is scaled down, which smooths its edges."""


class Renderer:
    """Draws one robot of an engine.

    Parameters
    ----------
    render_mode : {"rgb_array", "human"}
        ``"rgb_array"`` makes arrays, without a display. ``"human"`` shows a window. When the user closes it, the run
        goes on without pictures.
    fps : int
        Pictures a second in the window; `draw` waits accordingly.

    Raises
    ------
    ConfigError
        If the render mode is unknown, pygame is missing, or there is no display for a window.
    """

    def __init__(self, render_mode: str, fps: int) -> None:
        if render_mode not in RENDER_MODES:
            raise ConfigError(unknown_name("render mode", render_mode, RENDER_MODES))
        self.render_mode = render_mode
        self._fps = fps
        self._window: Window | None = None

    def draw(self, engine: Engine, row: int) -> np.ndarray | None:
        """Draw a robot's building, path and claims as they are now.

        Parameters
        ----------
        engine : Engine
        row : int
            The robot; it must have begun an episode.

        Returns
        -------
        A new (height, width, 3) uint8 array, or None with ``"human"``. Height and width are even, as video codecs want
        them, and the same for all plans of the engine's pool.
        """
        if self.render_mode == "rgb_array":
            picture = draw_picture(engine, row)
            columns = pygame.surfarray.pixels3d(picture)
            frame = np.empty((columns.shape[1], columns.shape[0], 3), np.uint8)
            for channel in range(3):  # one by one is many times faster than all at once
                frame[..., channel] = columns[..., channel].T
            return frame
        if self._window is None:
            hint = 'leave out --human, or use render_mode="rgb_array", which needs none.'
            self._window = Window(canvas_size(engine.config.plans), self._fps, hint)
        if self._window.is_open():
            self._window.show(draw_picture(engine, row))
        return None

    def close(self) -> None:
        """Close the window, if there is one; the next picture opens a new one."""
        if self._window is not None:
            self._window.close()
            self._window = None


class Window:
    """A window of our own, beside whatever else the process shows.

    Parameters
    ----------
    size : (width, height)
    fps : int
        Pictures a second; `show` waits accordingly.
    hint : str
        What is to be said to who has no display.

    Raises
    ------
    ConfigError
        If there is no display.
    """

    def __init__(self, size: tuple[int, int], fps: int, hint: str) -> None:
        hint = f"there is no display to show a window on; {hint}"
        shared = pygame.display.get_init()
        try:
            pygame.display.init()
            driver = pygame.display.get_driver()
        except pygame.error as error:
            raise ConfigError(f"{hint} ({error})") from error
        # Without a display, SDL may fall back to drivers that nobody can look at.
        if driver in ("offscreen", "dummy") and driver not in os.environ.get("SDL_VIDEODRIVER", ""):
            if not shared:
                pygame.display.quit()
            raise ConfigError(hint)
        self._window: Any = pygame.Window("CyclicLoop", size)
        self._clock = pygame.time.Clock()
        self._fps = fps

    def is_open(self) -> bool:
        """Tell whether the window is there, after a look at whether the user has closed it."""
        if self._window is None:
            return False
        if not pygame.display.get_init():  # somebody has shut down all of pygame, and the window with it
            self._window = None
            return False
        for event in pygame.event.get(pygame.WINDOWCLOSE):
            if event.window is not self._window:
                pygame.event.post(event)  # another window's
            else:
                self.close()
                return False
        return True

    def show(self, picture: pygame.Surface) -> None:
        """Show a picture, and wait until it is time for the next."""
        self._window.get_surface().blit(picture, (0, 0))
        self._window.flip()
        self._clock.tick(self._fps)

    def close(self) -> None:
        """Close the window."""
        if self._window is not None and pygame.display.get_init():
            self._window.destroy()
        self._window = None


def draw_picture(engine: Engine, row: int) -> pygame.Surface:
    """Return the picture of a robot, opaque, 32 bits a pixel."""
    scene = scene_of(engine.plan(row), canvas_size(engine.config.plans))
    moment = RobotSnapshot.of(engine, row)
    picture = opaque_surface(scene.size)
    _draw_layers(picture, scene.view, scene.overlay, moment, 1)
    if scene.inset is not None:
        x, y = scene.view.pixels(moment.pose[:2])
        reach = INSET_REACH * scene.view.scale
        pygame.draw.rect(picture, INK, (round(x - reach), round(y - reach), round(2 * reach), round(2 * reach)), 1)
        _draw_inset(picture, scene, scene.inset, moment)
    _draw_scores(picture, engine, row)
    return picture


@dataclass(frozen=True, slots=True)
class RobotSnapshot:
    """What there is to draw of a robot, by copies.

    Attributes
    ----------
    pose : (x, y, heading)
        The truth.
    hits_world : (num_beams, 2) float64
        Where the beams of the last reading end, as seen from the true pose.
    is_hit : (num_beams,) bool
        Whether they end before the laser's reach does.
    track : (t + 1, 3) float64
        x, y and path length of every step.
    claims : (n,) CLAIM
    seen : (rows, columns) int8
        As `Engine.seen_cells` has it.
    west, south, cell_size : float
        Corner and side of the cells, metres.
    radius : float
        Of the robot.
    """

    pose: tuple[float, float, float]
    hits_world: np.ndarray
    is_hit: np.ndarray
    track: np.ndarray
    claims: np.ndarray
    seen: np.ndarray
    west: float
    south: float
    cell_size: float
    radius: float

    @classmethod
    def of(cls, engine: Engine, row: int) -> RobotSnapshot:
        """Return what there is to draw of a robot."""
        info, config = engine.info[row], engine.config
        x, y, heading = float(info["x"]), float(info["y"]), float(info["heading"])
        ranges = engine.sensors.ranges[row]
        bearings = heading + config.laser.beam_spacing * np.arange(config.laser.num_beams)
        west, south, _, _ = engine.plan(row).bounds
        return cls(
            pose=(x, y, heading),
            hits_world=np.array([x, y]) + ranges[:, None] * np.stack([np.cos(bearings), np.sin(bearings)], axis=1),
            is_hit=ranges < config.laser.range_max,
            track=engine.trajectory(row),
            claims=engine.claims(row),
            seen=engine.seen_cells(row),
            west=west,
            south=south,
            cell_size=float(config.coverage.cell_size),
            radius=config.robot.radius,
        )


def _draw_layers(
    picture: pygame.Surface, view: View, overlay: pygame.Surface, moment: RobotSnapshot, thick: int
) -> None:
    """Draw the building and all that is in it; `thick` is how many times larger than it will be shown."""
    picture.fill(FLOOR)
    _draw_seen(picture, view, moment)
    picture.blit(overlay, (0, 0))
    _draw_fan(picture, view, moment, thick)
    _draw_way(picture, view, moment, thick)
    _draw_claims(picture, view, moment, thick)
    blit_middle(picture, start_mark(MARK * thick), *view.pixels(moment.track[0, :2]))
    radius = max(ROBOT_RADIUS_MIN * thick, moment.radius * view.scale)
    place = view.pixels(moment.pose[:2])
    blit_middle(picture, robot_mark(radius, moment.pose[2]), *place)
    if len(moment.claims) and moment.claims["step"][-1] == len(moment.track) - 1:
        blit_middle(picture, _claim_mark(moment.claims[-1], thick), *place)


def _claim_mark(claim: np.void, thick: int) -> pygame.Surface:
    if not claim["correct"]:
        return cross_mark(MARK * thick)
    return tick_mark((MARK + 2 if claim["new_cycle"] else MARK) * thick)


def _draw_seen(picture: pygame.Surface, view: View, moment: RobotSnapshot) -> None:
    """Tint the cells that have been seen, also where that is behind walls: the building is drawn over it."""
    size = moment.cell_size
    # The part of the grid that is in the picture, and a cell around it.
    left, bottom = view.west - view.left / view.scale, view.north - (picture.get_height() - view.top) / view.scale
    right, top = left + picture.get_width() / view.scale, bottom + picture.get_height() / view.scale
    first_column = max(0, math.floor((left - moment.west) / size) - 1)
    first_row = max(0, math.floor((bottom - moment.south) / size) - 1)
    part = moment.seen[
        first_row : max(0, math.ceil((top - moment.south) / size) + 1),
        first_column : max(0, math.ceil((right - moment.west) / size) + 1),
    ]
    if part.size == 0:
        return
    # A cell whose middle is inside a wall counts for nothing, but may have a strip of floor: it goes with the others.
    seen = part == 1
    near = seen.copy()
    near[1:] |= seen[:-1]
    near[:-1] |= seen[1:]
    beside = near.copy()
    near[:, 1:] |= beside[:, :-1]
    near[:, :-1] |= beside[:, 1:]
    seen |= near & (part < 0)
    # Smoothed where a cell is many pixels; larger cells first, since that shifts by up to half of what it scales.
    smooth = size * view.scale > 4
    repeat = max(1, round(size * view.scale / 5)) if smooth else 1
    shown = np.repeat(np.repeat(seen[::-1], repeat, axis=0), repeat, axis=1)
    red, green, blue = SEEN
    tint = np.where(shown, np.uint32(0xFF000000), np.uint32(0)) | np.uint32(red << 16 | green << 8 | blue)
    # As surfaces have it in memory, which makes it fast.
    cells = pygame.image.frombuffer(tint.astype("<u4").tobytes(), tint.shape[::-1], "BGRA")
    west, south = moment.west + first_column * size, moment.south + first_row * size
    corners = view.pixels([(west, south + part.shape[0] * size), (west + part.shape[1] * size, south)])
    (left, top), (right, bottom) = np.round(corners).astype(int).tolist()
    scale = pygame.transform.smoothscale if smooth else pygame.transform.scale
    picture.blit(scale(cells, (right - left, bottom - top)), (left, top))


def _draw_way(picture: pygame.Surface, view: View, moment: RobotSnapshot, thick: int) -> None:
    """Draw the path so far, paler the longer ago."""
    passed = np.floor(moment.track[:, 2] * view.scale / (PATH_GRAIN * thick))
    steps = np.append(np.flatnonzero(np.diff(passed, prepend=-1.0)), len(moment.track) - 1)
    points = view.pixels(moment.track[steps, :2])
    near = ((points > -8 * thick) & (points < np.array(picture.get_size()) + 8 * thick)).all(axis=1)
    inside, shades = near.astype(int), np.arange(len(points)) * PATH_SHADES // len(points)
    breaks = np.flatnonzero(np.diff(shades) | np.diff(inside)) + 1
    for first, last in pairwise([0, *breaks.tolist(), len(points) - 1]):
        if last > first and (inside[first] or inside[last]):
            colour = mix(PATH_OLD, PATH_NEW, shades[first] / (PATH_SHADES - 1))
            draw_line(picture, colour, points[first : last + 1], PATH_WIDTH * thick, smooth=thick == 1)


def _draw_fan(picture: pygame.Surface, view: View, moment: RobotSnapshot, thick: int) -> None:
    """Draw the beams of the last reading: a fan, and a dot where one met something."""
    ends = view.pixels(moment.hits_world)
    low = np.maximum(np.floor(ends.min(axis=0)) - 1, 0)
    high = np.minimum(np.ceil(ends.max(axis=0)) + 2, picture.get_size())
    layer = transparent_surface((int(high[0] - low[0]), int(high[1] - low[1])))
    layer.fill((*BEAM, 0))
    pygame.draw.polygon(layer, (*BEAM, FAN_ALPHA), ends - low)
    if thick > 1:
        x, y = view.pixels(moment.pose[:2]) - low
        for end in ends - low:
            pygame.draw.line(layer, (*BEAM, 2 * FAN_ALPHA), (x, y), end)
    picture.blit(layer, low)
    for x, y in np.round(ends[moment.is_hit]).astype(int).tolist():
        picture.fill(AMBER, (x - thick, y - thick, 2 * thick, 2 * thick))


def _draw_claims(picture: pygame.Surface, view: View, moment: RobotSnapshot, thick: int) -> None:
    """Draw each judged claim: a mark where it was made, and a line to the place that it named."""
    # Wrong ones last: they are the fewer, and must not be hidden.
    claims = moment.claims[np.argsort(~moment.claims["correct"], kind="stable")]
    places = view.pixels(moment.track[claims["step"], :2])
    named = view.pixels(moment.track[np.maximum(claims["match"], 0), :2])
    low, high = np.minimum(places, named), np.maximum(places, named)
    near = ((high > -MARK * thick) & (low < np.array(picture.get_size()) + MARK * thick)).all(axis=1)
    apart = np.hypot(*(named - places).T) > MARK * thick  # else the line is under the mark
    for i in np.flatnonzero(near & apart & (claims["match"] >= 0)).tolist():
        colour = RIGHT if claims["correct"][i] else WRONG
        draw_line(picture, colour, np.array([places[i], named[i]]), 2 * thick, smooth=thick == 1)
        blit_middle(picture, ring_mark(colour, 4 * thick), *named[i])
    for i in np.flatnonzero(near).tolist():
        blit_middle(picture, _claim_mark(claims[i], thick), *places[i])


def _draw_inset(picture: pygame.Surface, scene: Scene, place: pygame.Rect, moment: RobotSnapshot) -> None:
    """Draw the surroundings of the robot, large."""
    x, y, _ = moment.pose
    side = place.width * INSET_ZOOM
    view = View(x - INSET_REACH, y + INSET_REACH, side / (2 * INSET_REACH))
    close = opaque_surface((side, side))
    reach = INSET_REACH + 1  # the cut edges stay outside
    window = (x - reach, y - reach, x + reach, y + reach)
    free, walled = (shapely.clip_by_rect(geometry, *window) for geometry in (scene.free, scene.walled))
    _draw_layers(close, view, draw_building((side, side), view, free, walled), moment, INSET_ZOOM)
    picture.blit(pygame.transform.smoothscale(close, place.size), place)
    draw_scale_bar(picture, place.left + 10, place.bottom - 10, view.scale / INSET_ZOOM, 2.0)
    pygame.draw.rect(picture, INK, place.inflate(2, 2), 1)


def _draw_scores(picture: pygame.Surface, engine: Engine, row: int) -> None:
    """Draw the line of scores."""
    info, plan = engine.info[row], engine.plan(row)
    steps = int(engine.episodes.memory.status["steps"][row])
    right = int(info["claims"] - info["false_claims"])
    scores = [
        ("step", f"{steps:,} / {engine.config.step_budget_of(plan):,}", 0.0),
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
            for sprite, count in ((tick_mark(MARK), right), (cross_mark(MARK), int(info["false_claims"]))):
                blit_middle(picture, sprite, x + 7, SCORE_LINE)
                x = write(picture, str(count), TEXT_SIZE, INK, x + 19, SCORE_LINE) + 10
        else:
            write(picture, value, TEXT_SIZE, INK, x, SCORE_LINE)
