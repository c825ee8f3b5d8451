"""Drawing primitives: the view, marks, lines and text.

Other modules import pygame from here, so that one clear error says if it is missing. Nothing here needs a display.
World coordinates become pixels in one place, `View.pixels`, where row 0 becomes the north end.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from cyclic_env.errors import ConfigError
from cyclic_env.rendering.colors import AMBER, FLOOR, INK, RIGHT, WRONG, Color

os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # its greeting would mix with a command's output
try:
    import pygame
except ImportError as error:
    raise ConfigError(
        'rendering needs pygame-ce, which is missing; pip install "cyclic-loop[render]", or leave out render_mode.'
    ) from error

MARK = 7
"""Radius of a mark, pixels. The mark of a claim that closed a new cycle is 2 pixels larger."""
SPRITE_ZOOM = 4
"""How many times larger a mark is drawn before it is scaled down, which smooths its edges."""
TITLE_SIZE, TEXT_SIZE, LABEL_SIZE = 21, 18, 15


@dataclass(frozen=True, slots=True)
class View:
    """Where the world is in a picture: `scale` pixels per metre, with world (west, north) at pixel (left, top)."""

    west: float
    north: float
    scale: float
    left: float = 0.0
    top: float = 0.0

    def pixels(self, points: Any) -> np.ndarray:
        """Return the pixels (column, row) of world points `(..., 2)` in metres, not rounded."""
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
    """Draw a scale bar `metres` long from pixel (x, y) to the right."""
    left, bottom, length = round(x), round(y), round(metres * scale)
    for part in ((0, -1, length, 2), (0, -5, 2, 6), (length - 2, -5, 2, 6)):
        picture.fill(INK, (left + part[0], bottom + part[1], *part[2:]))
    write(picture, f"{metres:g} m", LABEL_SIZE, INK, left + length + 6, bottom - 3)


def _smooth(side: int, paint: Callable[[pygame.Surface, float], None]) -> pygame.Surface:
    """Return a smooth mark of `side` pixels; `paint` draws it enlarged, from -1 to 1, given the pixels per unit."""
    large = transparent_surface((side * SPRITE_ZOOM, side * SPRITE_ZOOM))
    large.fill((*FLOOR, 0))
    paint(large, side * SPRITE_ZOOM / 2)
    return pygame.transform.smoothscale(large, (side, side))


def _shape(large: pygame.Surface, unit: float, color: Color, points: Sequence[Sequence[float]]) -> None:
    pygame.draw.polygon(large, color, [(unit * (1 + x), unit * (1 + y)) for x, y in points])


def _disc(large: pygame.Surface, unit: float, color: Color, radius: float) -> None:
    pygame.draw.circle(large, color, (unit, unit), unit * radius)


@lru_cache(maxsize=64)
def tick_mark(radius: int) -> pygame.Surface:
    """Return the mark of a correct claim: a green disc with a tick."""

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
        for color, half, reach in ((FLOOR, 0.36, 0.66), (WRONG, 0.2, 0.58)):
            for turn in (1, -1):
                corners = [(-reach - half, turn * (half - reach)), (half - reach, turn * (-reach - half))]
                _shape(large, unit, color, [*corners, *((-x, -y) for x, y in corners)])

    return _smooth(2 * radius + 1, paint)


@lru_cache(maxsize=64)
def ring_mark(color: Color, radius: int) -> pygame.Surface:
    """Return the mark of a position that a claim named: a ring."""

    def paint(large: pygame.Surface, unit: float) -> None:
        _disc(large, unit, color, 1.0)
        _disc(large, unit, FLOOR, 0.55)

    return _smooth(2 * radius + 1, paint)


@lru_cache(maxsize=64)
def start_mark(radius: int) -> pygame.Surface:
    """Return the mark of the start: a diamond."""

    def paint(large: pygame.Surface, unit: float) -> None:
        for color, reach in ((FLOOR, 1.0), (INK, 0.78), (FLOOR, 0.3)):
            _shape(large, unit, color, [(-reach, 0), (0, -reach), (reach, 0), (0, reach)])

    return _smooth(2 * radius + 1, paint)


def swatch(color: Color, height: int = 12) -> pygame.Surface:
    """Return a patch of colour for the legend."""
    surface = transparent_surface((16, height))
    surface.fill(color)
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
    """Return a black surface. Its depth is fixed, so that it doesn't depend on the display."""
    return pygame.Surface(size, 0, 32)


def transparent_surface(size: tuple[int, int]) -> pygame.Surface:
    """Return a fully transparent surface."""
    return pygame.Surface(size, pygame.SRCALPHA, 32)


def blit_centered(picture: pygame.Surface, sprite: pygame.Surface, x: float, y: float) -> None:
    """Draw a mark centred at pixel (x, y)."""
    width, height = sprite.get_size()
    picture.blit(sprite, (round(x - width / 2), round(y - height / 2)))


def draw_line(picture: pygame.Surface, color: Color, points: np.ndarray, width: int, *, smooth: bool) -> None:
    """Draw a line `width` pixels wide. `smooth` is slower, and useless where the picture is scaled down later."""
    if not smooth:
        pygame.draw.lines(picture, color, False, points, width)
        return
    along = np.diff(points, axis=0, append=2 * points[-1:] - points[-2:-1])
    across = along[:, ::-1] * (-1, 1) / np.maximum(np.hypot(along[:, :1], along[:, 1:]), 1e-9)
    for i in range(width):
        pygame.draw.aalines(picture, color, False, points + (i - (width - 1) / 2) * across)


def mix(first: Color, second: Color, share: float) -> Color:
    """Return the colour at `share` between the first (0) and the second (1)."""
    red, green, blue = (round(a + share * (b - a)) for a, b in zip(first, second, strict=True))
    return red, green, blue


@lru_cache(maxsize=1024)
def render_text(text: str, size: int, color: Color) -> pygame.Surface:
    """Return a line of text in pygame's own font. The font is not kept, because ``pygame.quit()`` would break it."""
    pygame.font.init()
    return pygame.font.Font(None, size).render(text, True, color)


def write(picture: pygame.Surface, text: str, size: int, color: Color, x: int, middle: int) -> int:
    """Write a line from pixel column x, centred on row `middle`; return the column where it ends."""
    if not text:
        return x
    line = render_text(text, size, color)
    picture.blit(line, (x, middle - line.get_height() // 2))
    return x + line.get_width()


def shorten(text: str, size: int, width: int) -> str:
    """Return the text, cut off with dots if it is wider than `width` pixels."""
    shown = text
    while shown and render_text(shown, size, INK).get_width() > width:
        text = text[:-1].rstrip()
        shown = f"{text}..." if text else ""
    return shown
