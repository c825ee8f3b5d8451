"""Animations of runs as small GIF files, which show every mark of the pictures."""

from __future__ import annotations

import math
from itertools import combinations_with_replacement
from pathlib import Path

from cyclic_env.atomic_write import atomic_write
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
from cyclic_env.rendering.renderer import DrawableEnv, draw_picture, pygame

try:
    from PIL import Image
except ImportError as error:
    raise ConfigError('animations need pillow, which is missing; pip install "cyclic-loop[plot]".') from error

FRAMES_MAX = 250
"""Number of frames of an episode that uses its whole step budget; a shorter one has fewer."""
FRAME_WIDTH = 720
"""Width of a frame, pixels."""
FRAME_COLORS = (FLOOR, INK, FAINT, SOLID, WALL, SEEN, PATH_OLD, PATH_NEW, AMBER, BEAM, RIGHT, WRONG)
"""A frame's palette consists of these and the mean of every two of them."""
FRAME_S, LAST_FRAME_S = 0.08, 3.0
"""Seconds for which each frame, and the last one, is shown."""


class GifWriter:
    """Collects the frames of a run's animation and writes it.

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
                for a, b in combinations_with_replacement(FRAME_COLORS, 2)
                for pair in zip(a, b, strict=True)
            ]
        )
        self._taken = -1

    def take(self, step: int, *, last: bool = False) -> None:
        """Add the picture of a step if it is due or the `last`."""
        budget = self._env.engine.step_budget(0)
        if step == self._taken or (step % math.ceil(budget / FRAMES_MAX) and not last):
            return
        self._taken = step
        surface = draw_picture(self._env)
        picture = Image.frombytes("RGB", surface.get_size(), pygame.image.tobytes(surface, "RGB"))
        size = (FRAME_WIDTH, round(FRAME_WIDTH * picture.height / picture.width))
        picture = picture.resize(size, Image.Resampling.BOX)  # a box filter keeps flat areas flat
        self._frames.append(picture.quantize(palette=self._palette, dither=Image.Dither.NONE))

    def write(self, path: Path) -> None:
        """Write the animation, which repeats endlessly.

        Raises
        ------
        ConfigError
            If the file can't be written.
        """
        first, *others = self._frames
        durations = [round(1000 * FRAME_S)] * len(others) + [round(1000 * LAST_FRAME_S)]
        try:
            with atomic_write(path) as part:
                first.save(part, "GIF", save_all=True, append_images=others, duration=durations, loop=0, optimize=False)
        except OSError as error:
            raise ConfigError(f"can't write to {path}: {error.strerror or error}.") from error
