"""An animation of a run, for a page: small, and for all that with every mark that the pictures have."""

from __future__ import annotations

import math
from itertools import combinations_with_replacement
from pathlib import Path
from typing import Protocol

from cyclic_env.atomic_write import atomic_write
from cyclic_env.engine.engine import Engine
from cyclic_env.errors import ConfigError
from cyclic_env.rendering.colors import (
    AMBER,
    BEAM,
    FAINT,
    FLOOR,
    INK,
    PATH_NEW,
    PATH_OLD,
    RIGHT,
    SEEN,
    SOLID,
    WALL,
    WRONG,
)
from cyclic_env.rendering.renderer import draw_picture, pygame

try:
    from PIL import Image
except ImportError as error:
    raise ConfigError('animations need pillow, which is missing; pip install "cyclic-loop[plot]".') from error

FRAMES_MAX = 250
"""Frames of an animation of the longest episode; one that ends earlier has fewer."""
FRAME_WIDTH = 720
"""Pixels."""
FRAME_COLOURS = (FLOOR, INK, FAINT, SOLID, WALL, SEEN, PATH_OLD, PATH_NEW, AMBER, BEAM, RIGHT, WRONG)
"""What a frame is made of, and the means of any two of these."""
FRAME_S, LAST_FRAME_S = 0.08, 3.0
"""Seconds for which a frame is shown, and the last."""


class DrawableEnv(Protocol):
    """What is drawn: a `CyclicLoopEnv`."""

    engine: Engine

    @property
    def step_budget(self) -> int:
        """Steps after which the episode is truncated."""
        ...


class GifWriter:
    """An animation of a run: its pictures, few enough, small enough and of few enough colours.

    Parameters
    ----------
    env : CyclicLoopEnv
    """

    def __init__(self, env: DrawableEnv) -> None:
        self._env = env
        self._frames: list[Image.Image] = []
        self._palette = Image.new("P", (1, 1))
        self._palette.putpalette(
            [
                sum(pair) // 2
                for a, b in combinations_with_replacement(FRAME_COLOURS, 2)
                for pair in zip(a, b, strict=True)
            ]
        )
        self._taken = -1

    def take(self, step: int, *, last: bool = False) -> None:
        """Take the picture of a step, if it is one of those to be shown or the last."""
        if step == self._taken or (step % math.ceil(self._env.step_budget / FRAMES_MAX) and not last):
            return
        self._taken = step
        surface = draw_picture(self._env.engine, 0)
        picture = Image.frombytes("RGB", surface.get_size(), pygame.image.tobytes(surface, "RGB"))
        size = (FRAME_WIDTH, round(FRAME_WIDTH * picture.height / picture.width))
        picture = picture.resize(size, Image.Resampling.BOX)  # keeps areas of one colour so, which makes the file small
        self._frames.append(picture.quantize(palette=self._palette, dither=Image.Dither.NONE))

    def write(self, path: Path) -> None:
        """Write the animation, which runs again and again.

        Raises
        ------
        ConfigError
            If there is no picture, or the file can't be written.
        """
        if not self._frames:
            raise ConfigError("there is no picture to make an animation of.")
        first, *others = self._frames
        durations = [round(1000 * FRAME_S)] * len(others) + [round(1000 * LAST_FRAME_S)]
        try:
            with atomic_write(path) as part:
                first.save(part, "GIF", save_all=True, append_images=others, duration=durations, loop=0, optimize=False)
        except OSError as error:
            raise ConfigError(f"can't write to {path}: {error.strerror or error}.") from error
