"""Masks grown by discs, and free space grown back to the walls."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from cyclic_env.floor_plans.occupancy.morphology import dilated, grow_back


def count_holes(mask: np.ndarray) -> int:
    return ndimage.label(~np.pad(mask, 1), np.ones((3, 3)))[1] - 1


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.005, 0.08))
def test_growing_back_to_the_walls_keeps_holes_and_makes_none(seed: int, density: float) -> None:
    rng = np.random.default_rng(seed)
    free = np.pad(rng.random((60, 80)) > density, 1)
    labels = ndimage.label(~dilated(~free, 3.5))[0]
    if not labels.any():
        return
    centres = labels == 1 + np.argmax(np.bincount(labels.ravel())[1:])
    space = grow_back(centres, free, 3.5, 2.0, 50.0)
    assert (space | centres == space).all()
    assert not (space & ~free).any()
    assert ndimage.label(space)[1] == 1
    assert count_holes(space) == count_holes(centres)


@given(st.integers(0, 2**32 - 1), st.floats(0.8, 9.0))
def test_discs_are_as_large_as_distances_say(seed: int, radius: float) -> None:
    mask = np.random.default_rng(seed).random((30, 40)) < 0.02
    mask[3, 4] = True
    assert (dilated(mask, radius) == (ndimage.distance_transform_edt(~mask) < radius)).all()
