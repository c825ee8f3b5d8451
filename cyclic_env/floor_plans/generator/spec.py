"""What a generated building is to be like, the splits of such buildings, and the random stream that draws them."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np

from cyclic_env.errors import FloorPlanError
from cyclic_env.validation import short_repr

PREFIX = "generated"
"""A map's name that begins with this and a colon is a building to be generated."""

VERSIONS = (1,)
SEED_MAX = 2**32 - 1
HAND_SEED_MAX = 999_999
"""Largest seed that a name may give; those above belong to the splits."""

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
"""Least and largest value of each key; whole numbers where these are."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BuildingSpec:
    """What a generated building is like, checked when made; the keys of a name ``generated:key=value,...``.

    Parameters
    ----------
    cycles : int
        Cycles of the building, exactly: its blocks. Without any, it is a tree of corridors.
    seed : int
        Of all that is drawn.
    size : float
        Metres between neighbouring parallel corridors; where that is not the standard, from 0.75 to 1.4 times so much.
    width : float
        Metres across a corridor; where that is not the standard, from 0.75 to 1.3 times so much, and at least 1.6 m.
    rooms : float
        Share of the stretches of corridor between crossings that have a room, where there is space for it.
    dead_ends : int
        Corridors that end blindly, exactly.
    diagonal : float
        Share of the corners that are cut by a corridor at 45 degrees.
    aliasing : float
        Share of all choices that are the building's standard ones: 0, every corridor is its own; 1, all are alike.
    version : int
        Of the generator. What a version draws never changes.

    Raises
    ------
    FloorPlanError
        If a value is out of range, or some do not go together.
    """

    cycles: int = 4
    seed: int = 0
    size: float = 22.0
    width: float = 2.4
    rooms: float = 0.25
    dead_ends: int = 2
    diagonal: float = 0.0
    aliasing: float = 0.0
    version: int = 1

    def __post_init__(self) -> None:
        if self.version not in VERSIONS:
            known = ", ".join(map(str, VERSIONS))
            raise FloorPlanError(f"version is {short_repr(self.version)}; this generator knows version {known}.")
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
        """Metres between parallel corridors at least, so that a block's ring is longer than 40 m.

        The ring of a square block of spacing p, its corridors as wide as may be and all its corners cut, is at least
        ``4 (p - 1.3 width) - 4 (2 - sqrt(2)) p / 4``.
        """
        return 12.0 + 1.6 * self.width

    @property
    def name(self) -> str:
        """The map's name: `cycles` and `seed`, and the other keys that are not at their defaults, in order."""
        keys = [f.name for f in fields(self) if f.name in ("cycles", "seed") or getattr(self, f.name) != f.default]
        values = (np.format_float_positional(getattr(self, key), trim="-") for key in keys)
        return f"{PREFIX}:" + ",".join(f"{key}={value}" for key, value in zip(keys, values, strict=True))


class Split(NamedTuple):
    """A set of buildings with a name: their number, and the seed of the first."""

    plans: int
    first_seed: int


SPLITS = {"train": Split(256, 1_000_000), "validation": Split(64, 2_000_000), "test": Split(200, 3_000_000)}
"""Buildings to learn from, to choose by, and to report on; the last must never be used to tune anything."""


def split_spec(split: str, index: int) -> BuildingSpec:
    """Return what building `index` of a split is like, drawn from its seed over the ranges of the benchmark."""
    seed = SPLITS[split].first_seed + index
    draw = Draw(1, seed, 0)
    return BuildingSpec(
        seed=seed,
        cycles=1 + draw.below(8),
        aliasing=draw.between(0.0, 1.0),
        size=draw.between(18.0, 28.0),
        width=draw.between(1.8, 3.0),
        rooms=draw.between(0.0, 0.6),
        dead_ends=draw.below(5),
        diagonal=max(0.0, draw.between(-1.0, 1.0)),
    )


class Draw:
    """Random choices of one stream, by ``random()`` alone: what it yields for a seed has never changed in NumPy."""

    def __init__(self, version: int, seed: int, stream: int) -> None:
        self._random = np.random.Generator(np.random.PCG64(np.random.SeedSequence((version, seed, stream)))).random

    def below(self, count: int) -> int:
        """Return a whole number from 0 to count - 1."""
        return int(self._random() * count)

    def between(self, low: float, high: float) -> float:
        """Return a number to two places: metres to the centimetre, shares to the percent."""
        return round(low + (high - low) * self._random(), 2)

    def chance(self, share: float) -> bool:
        """Return True with that probability."""
        return self._random() < share

    def shares(self, *shape: int) -> list[Any]:
        """Return numbers from 0 to 1, in nested lists of that shape."""
        return self._random(shape).tolist()

    def order(self, count: int) -> list[int]:
        """Return the numbers below `count` in a random order."""
        return sorted(range(count), key=self.shares(count).__getitem__)
