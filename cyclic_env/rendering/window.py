"""A window that shows frames."""

from __future__ import annotations

import os
from typing import Any

from cyclic_env.errors import ConfigError
from cyclic_env.rendering.primitives import pygame


class Window:
    """A window of its own, independent of other windows of the process.

    Parameters
    ----------
    size : (width, height)
    fps : int
        Frames per second; `show` waits accordingly.
    hint : str
        Advice for the error message where there is no display.

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
        # Without a display, SDL may fall back to a driver that shows nothing.
        if driver in ("offscreen", "dummy") and driver not in os.environ.get("SDL_VIDEODRIVER", ""):
            if not shared:
                pygame.display.quit()
            raise ConfigError(hint)
        self._window: Any = pygame.Window("CyclicLoop", size)
        self._clock = pygame.time.Clock()
        self._fps = fps

    def is_open(self) -> bool:
        """Check whether the user has closed the window, and return whether it is still open."""
        if self._window is None:
            return False
        if not pygame.display.get_init():  # other code has quit pygame, which closed the window
            self._window = None
            return False
        for event in pygame.event.get(pygame.WINDOWCLOSE):
            if event.window is not self._window:
                pygame.event.post(event)  # it belongs to another window
            else:
                self.close()
                return False
        return True

    def show(self, picture: pygame.Surface) -> None:
        """Show a picture, and wait until the next one is due."""
        self._window.get_surface().blit(picture, (0, 0))
        self._window.flip()
        self._clock.tick(self._fps)

    def close(self) -> None:
        """Close the window."""
        if self._window is not None and pygame.display.get_init():
            self._window.destroy()
        self._window = None
