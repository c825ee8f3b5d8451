"""The kernels' arguments packed into one object, since numba unpacks a tuple of fifty arrays in 10 us at every call."""

from __future__ import annotations

from functools import partial
from typing import Any

from numba import types
from numba.experimental import structref

from cyclic_env.engine.kernels import judge_rows
from cyclic_env.jit import compiled


@structref.register
class _PackedType(types.StructRef):
    """The type of `Packed` in kernels."""


class Packed(structref.StructRefProxy):
    """The tuples of `cyclic_env.engine.building` in a form that kernels take as it is; made by `pack`."""


structref.define_boxing(_PackedType, Packed)
structref.define_constructor(Packed, _PackedType, ["buildings", "episodes"])


@partial(compiled, counts_references=True)
def pack(buildings, episodes):
    """Return the two tuples as one object, which shares their arrays."""
    return Packed(buildings, episodes)


@partial(compiled, counts_references=True)
def judge_packed_rows(packed: Any, rows: Any, claimed: Any) -> None:
    """Do what `judge_rows` does."""
    judge_rows(packed.buildings, packed.episodes, rows, claimed)
