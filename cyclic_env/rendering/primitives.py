"""Drawing: the colours, the marks, the lines and the letters of a picture, and where the world is in it.

It imports pygame for all who draw, and says what to do where that is missing. Nothing here needs a display.

World coordinates become pixels in one place, `View.pixels`; there the picture is turned, row 0 being the north end.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from cyclic_env.errors import ConfigError
from cyclic_env.rendering.colors import AMBER, FLOOR, INK, RIGHT, WRONG, Colour


@contextmanager
def _without_greeting() -> Iterator[None]:
    """Keep pygame from printing a line at its import; what it prints on may be somebody's data."""
    name = "PYGAME_HIDE_SUPPORT_PROMPT"
    before = os.environ.get(name)
    os.environ[name] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ[name]
        else:
            os.environ[name] = before


try:
    with _without_greeting():
        import pygame
except ImportError as error:
    raise ConfigError(
        'rendering needs pygame-ce, which is missing; pip install "cyclic-loop[render]", or leave out render_mode.'
    ) from error

MARK = 7
"""Radius of a mark, pixels; that of a claim that closed a new cycle is 2 larger."""
SPRITE_ZOOM = 4
"""How many times larger a mark is drawn before it is scaled down, which smooths its edges."""
TITLE_SIZE, TEXT_SIZE, LABEL_SIZE = 21, 18, 15


@dataclass(frozen=True, slots=True)
class View:
    """Where the world is in a picture: `scale` pixels a metre, the world's (west, north) at pixel (left, top)."""

    west: float
    north: float
    scale: float
    left: float = 0.0
    top: float = 0.0

    def pixels(self, points: Any) -> np.ndarray:
        """Return the pixels (column, row), not rounded, of world points `(..., 2)` in metres."""
        points = np.asarray(points, np.float64)
        return np.stack(
            [
                self.left + self.scale * (points[..., 0] - self.west),
                self.top + self.scale * (self.north - points[..., 1]),
            ],
            axis=-1,
        )

    def world(self, pixel: Any) -> np.ndarray:
        """Return the world points `(..., 2)` of pixels (column, row)."""
        pixel = np.asarray(pixel, np.float64)
        return np.stack(
            [
                self.west + (pixel[..., 0] - self.left) / self.scale,
                self.north - (pixel[..., 1] - self.top) / self.scale,
            ],
            axis=-1,
        )

    def zoomed(self, zoom: float) -> View:
        """Return the view of a picture `zoom` times larger."""
        return View(self.west, self.north, self.scale * zoom, self.left * zoom, self.top * zoom)


def draw_scale_bar(picture: pygame.Surface, x: float, y: float, scale: float, metres: float) -> None:
    """Draw a scale of so many metres from pixel (x, y) to the right."""
    left, bottom, length = round(x), round(y), round(metres * scale)
    for part in ((0, -1, length, 2), (0, -5, 2, 6), (length - 2, -5, 2, 6)):
        picture.fill(INK, (left + part[0], bottom + part[1], *part[2:]))
    write(picture, f"{metres:g} m", LABEL_SIZE, INK, left + length + 6, bottom - 3)


def _smooth(side: int, paint: Callable[[pygame.Surface, float], None]) -> pygame.Surface:
    """Return a transparent mark of that side, painted in coordinates from -1 to 1 at so many pixels a unit."""
    large = transparent_surface((side * SPRITE_ZOOM, side * SPRITE_ZOOM))
    large.fill((*FLOOR, 0))
    paint(large, side * SPRITE_ZOOM / 2)
    return pygame.transform.smoothscale(large, (side, side))


def _shape(large: pygame.Surface, unit: float, colour: Colour, points: Sequence[Sequence[float]]) -> None:
    pygame.draw.polygon(large, colour, [(unit * (1 + x), unit * (1 + y)) for x, y in points])


def _disc(large: pygame.Surface, unit: float, colour: Colour, radius: float) -> None:
    pygame.draw.circle(large, colour, (unit, unit), unit * radius)


@lru_cache(maxsize=64)
def tick_mark(radius: int) -> pygame.Surface:
    """Return the mark of a right claim: a green disc with a tick."""

    def paint(large: pygame.Surface, unit: float) -> None:
        _disc(large, unit, FLOOR, 1.0)
        _disc(large, unit, RIGHT, 0.86)
        stroke = [(-0.5, 0.02), (-0.3, -0.18), (-0.1, 0.04), (0.36, -0.42), (0.54, -0.22), (-0.1, 0.44)]
        _shape(large, unit, FLOOR, stroke)

    return _smooth(2 * radius + 1, paint)


@lru_cache(maxsize=64)
def cross_mark(radius: int) -> pygame.Surface:
    """Return the mark of a false claim: a red cross."""

    def paint(large: pygame.Surface, unit: float) -> None:
        for colour, half, reach in ((FLOOR, 0.36, 0.66), (WRONG, 0.2, 0.58)):
            for turn in (1, -1):
                corners = [(-reach - half, turn * (half - reach)), (half - reach, turn * (-reach - half))]
                _shape(large, unit, colour, [*corners, *((-x, -y) for x, y in corners)])

    return _smooth(2 * radius + 1, paint)


@lru_cache(maxsize=64)
def ring_mark(colour: Colour, radius: int) -> pygame.Surface:
    """Return the mark of a place that a claim named."""

    def paint(large: pygame.Surface, unit: float) -> None:
        _disc(large, unit, colour, 1.0)
        _disc(large, unit, FLOOR, 0.55)

    return _smooth(2 * radius + 1, paint)


@lru_cache(maxsize=64)
def start_mark(radius: int) -> pygame.Surface:
    """Return the mark of the start: a diamond."""

    def paint(large: pygame.Surface, unit: float) -> None:
        for colour, reach in ((FLOOR, 1.0), (INK, 0.78), (FLOOR, 0.3)):
            _shape(large, unit, colour, [(-reach, 0), (0, -reach), (reach, 0), (0, reach)])

    return _smooth(2 * radius + 1, paint)


def swatch(colour: Colour, height: int = 12) -> pygame.Surface:
    """Return a patch of colour for the legend."""
    surface = transparent_surface((16, height))
    surface.fill(colour)
    return surface


def robot_mark(radius: float, heading: float) -> pygame.Surface:
    """Return the robot: a disc with an arrow that points where it is heading."""
    cos, sin = math.cos(heading), math.sin(heading)

    def paint(large: pygame.Surface, unit: float) -> None:
        _disc(large, unit, FLOOR, 1.0)
        _disc(large, unit, INK, 0.9)
        _disc(large, unit, AMBER, 0.74)
        arrow = [(0.68, 0.0), (-0.4, 0.46), (-0.14, 0.0), (-0.4, -0.46)]
        _shape(large, unit, INK, [(cos * x - sin * y, -sin * x - cos * y) for x, y in arrow])

    return _smooth(2 * math.ceil(radius) + 1, paint)


def opaque_surface(size: tuple[int, int]) -> pygame.Surface:
    """Return a black surface; its depth is given, so that it is the same with any display and with none."""
    return pygame.Surface(size, 0, 32)


def transparent_surface(size: tuple[int, int]) -> pygame.Surface:
    """Return a surface with opacity, all of it transparent."""
    return pygame.Surface(size, pygame.SRCALPHA, 32)


def blit_middle(picture: pygame.Surface, sprite: pygame.Surface, x: float, y: float) -> None:
    """Put a mark with its middle at pixel (x, y)."""
    width, height = sprite.get_size()
    picture.blit(sprite, (round(x - width / 2), round(y - height / 2)))


def draw_line(picture: pygame.Surface, colour: Colour, points: np.ndarray, width: int, *, smooth: bool) -> None:
    """Draw a line of `width` pixels; `smooth` is slower, and of no use where the picture is scaled down."""
    if not smooth:
        pygame.draw.lines(picture, colour, False, points, width)
        return
    along = np.diff(points, axis=0, append=2 * points[-1:] - points[-2:-1])
    across = along[:, ::-1] * (-1, 1) / np.maximum(np.hypot(along[:, :1], along[:, 1:]), 1e-9)
    for i in range(width):
        pygame.draw.aalines(picture, colour, False, points + (i - (width - 1) / 2) * across)


def mix(first: Colour, second: Colour, share: float) -> Colour:
    """Return the colour that lies that share of the way from the first to the second."""
    red, green, blue = (round(a + share * (b - a)) for a, b in zip(first, second, strict=True))
    return red, green, blue


@lru_cache(maxsize=1024)
def words(text: str, size: int, colour: Colour) -> pygame.Surface:
    """Return a line in pygame's own font. The font is not kept: it would not outlive a ``pygame.quit()`` of others."""
    pygame.font.init()
    return pygame.font.Font(None, size).render(text, True, colour)


def write(picture: pygame.Surface, text: str, size: int, colour: Colour, x: int, middle: int) -> int:
    """Write a line from pixel column x; return the column where it ends."""
    if not text:
        return x
    line = words(text, size, colour)
    picture.blit(line, (x, middle - line.get_height() // 2))
    return x + line.get_width()


def shortened(text: str, size: int, width: int) -> str:
    """Return a text, cut off with dots where it would be wider."""
    shown = text
    while shown and words(shown, size, INK).get_width() > width:
        text = text[:-1].rstrip()
        shown = f"{text}..." if text else ""
    return shown
