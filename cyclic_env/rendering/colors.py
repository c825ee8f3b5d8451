"""The colours of frames and figures, red, green and blue from 0 to 255."""

from __future__ import annotations

Color = tuple[int, int, int]

PAPER, INK, FAINT, RULE = (250, 250, 248), (38, 45, 56), (120, 128, 138), (214, 217, 221)
SOLID, WALL, FLOOR, SEEN = (226, 229, 233), (62, 71, 84), (250, 250, 248), (205, 226, 240)
PATH_OLD, PATH_NEW = (150, 176, 208), (24, 78, 152)
AMBER, BEAM = (246, 170, 28), (255, 198, 64)
RIGHT, WRONG = (0, 138, 98), (206, 32, 52)
"""Colours of correct and of false claims. For the colour-blind, they differ in lightness, and the marks in shape."""
