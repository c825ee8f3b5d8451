"""The specification of a generated building, the splits of such buildings, and the random stream that draws them."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np

from cyclic_env.errors import FloorPlanError
from cyclic_env.validation import short_repr

PREFIX = "generated"
"""The name of a generated building begins with this and a colon."""

SEED_MAX = 2**32 - 1
HAND_SEED_MAX = 999_999
"""Greatest seed that a name may give; those above belong to the splits."""

RANGES: dict[str, tuple[float, float]] = {
    "cycles": (0, 12),
    "seed": (0, SEED_MAX),
    "size": (16.0, 40.0),
    "width": (1.6, 3.6),
    "rooms": (0.0, 1.0),
    "dead_ends": (0, 12),
    "diagonal": (0.0, 1.0),
    "aliasing": (0.0, 1.0),
}
"""Least and greatest value of each key; keys with integer bounds take integers only."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BuildingSpec:
    """Specification of a generated building; its fields are the keys of a name ``generated:key=value,...``.

    Parameters
    ----------
    cycles : int
        Exact number of cycles, each around a block. With 0, the building is a tree of corridors.
    seed : int
        Seed of everything random.
    size : float
        Standard distance between parallel neighbouring corridors, metres; others are 0.75 to 1.4 times as far apart.
    width : float
        Standard width of a corridor, metres; others are 0.75 to 1.3 times as wide, and at least 1.6 m.
    rooms : float
        Share of the stretches of corridor between crossings that have a room, where there is space for it.
    dead_ends : int
        Exact number of corridors with a dead end.
    diagonal : float
        Share of the corners that are cut by a corridor at 45 degrees.
    aliasing : float
        Share of all choices that are the building's standard ones: at 0 every corridor is unique, at 1 all are alike.

    Raises
    ------
    FloorPlanError
        If a value is out of range, or the values contradict each other.
    """

    cycles: int = 4
    seed: int = 0
    size: float = 22.0
    width: float = 2.4
    rooms: float = 0.25
    dead_ends: int = 2
    diagonal: float = 0.0
    aliasing: float = 0.0

    def __post_init__(self) -> None:
        for key, (least, most) in RANGES.items():
            value = getattr(self, key)
            whole = isinstance(most, int)
            right = isinstance(value, int if whole else int | float) and not isinstance(value, bool)
            if not right or not least <= value <= most:
                kind = "a whole number" if whole else "a number"
                raise FloorPlanError(f"{key} is {short_repr(value)}; expected {kind} from {least:.10g} to {most:.10g}.")
        if self.size < self.spacing_min:
            raise FloorPlanError(
                f"size is {self.size:g}, too small for corridors {self.width:g} m wide: a block's ring must be longer "
                f"than 40 m; expected at least {math.ceil(10 * self.spacing_min) / 10:g}, or a smaller width."
            )
        if self.cycles == 0 and self.dead_ends < 2:
            raise FloorPlanError(
                f"dead_ends is {self.dead_ends}, but a building without a cycle has 2 ends or more; "
                "give dead_ends=2, or a cycle."
            )

    @property
    def spacing_min(self) -> float:
        """Least distance between parallel corridors for a block's ring to be longer than 40 m, metres.

        The ring of a square block between corridors p apart, as wide as they get and with all corners cut, is at least
        ``4 (p - 1.3 width) - 4 (2 - sqrt(2)) p / 4`` long.
        """
        return 12.0 + 1.6 * self.width

    @property
    def name(self) -> str:
        """The map's name: `cycles`, `seed`, and the keys that differ from their defaults, in order."""
        keys = [f.name for f in fields(self) if f.name in ("cycles", "seed") or getattr(self, f.name) != f.default]
        values = (np.format_float_positional(getattr(self, key), trim="-") for key in keys)
        return f"{PREFIX}:" + ",".join(f"{key}={value}" for key, value in zip(keys, values, strict=True))


class Split(NamedTuple):
    """A named set of buildings: their number, the seed of the first, and the ranges of their cycles and aliasing."""

    plans: int
    first_seed: int
    cycles: tuple[int, int] = (1, 8)
    aliasing: tuple[float, float] = (0.0, 1.0)


HARD_CYCLES, HARD_ALIASING = (6, 12), (0.7, 1.0)
"""Ranges of the hard splits: many loops to close, in buildings whose places look alike."""

SPLITS = {
    "train": Split(256, 1_000_000),
    "validation": Split(64, 2_000_000),
    "test": Split(200, 3_000_000),
    "hard_train": Split(256, 4_000_000, HARD_CYCLES, HARD_ALIASING),
    "hard_validation": Split(64, 5_000_000, HARD_CYCLES, HARD_ALIASING),
    "hard_test": Split(200, 6_000_000, HARD_CYCLES, HARD_ALIASING),
}
"""Buildings to train on, to choose settings with, and to report results on; nothing may be tuned on the last."""


def split_spec(split: str, index: int) -> BuildingSpec:
    """Return the specification of building `index` of a split, drawn from its seed over the ranges of the benchmark."""
    chosen = SPLITS[split]
    seed = chosen.first_seed + index
    draw = Draw(seed, 0)
    fewest, most = chosen.cycles
    return BuildingSpec(
        seed=seed,
        cycles=fewest + draw.below(most - fewest + 1),
        aliasing=draw.between(*chosen.aliasing),
        size=draw.between(18.0, 28.0),
        width=draw.between(1.8, 3.0),
        rooms=draw.between(0.0, 0.6),
        dead_ends=draw.below(5),
        diagonal=max(0.0, draw.between(-1.0, 1.0)),
    )


class Draw:
    """Random choices of one stream, made by ``random()`` alone, whose output for a seed has never changed in NumPy."""

    def __init__(self, seed: int, stream: int) -> None:
        self._random = np.random.Generator(np.random.PCG64(np.random.SeedSequence((1, seed, stream)))).random

    def below(self, count: int) -> int:
        """Return a whole number from 0 to count - 1."""
        return int(self._random() * count)

    def between(self, low: float, high: float) -> float:
        """Return a number rounded to two decimals: metres to the centimetre, shares to the percent."""
        return round(low + (high - low) * self._random(), 2)

    def chance(self, share: float) -> bool:
        """Return True with that probability."""
        return self._random() < share

    def shares(self, *shape: int) -> list[Any]:
        """Return numbers from 0 to 1 in nested lists of that shape."""
        return self._random(shape).tolist()

    def order(self, count: int) -> list[int]:
        """Return the numbers below `count` in a random order."""
        return sorted(range(count), key=self.shares(count).__getitem__)
