"""What the explorer draws: groups and open areas."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from agents.knn.plotting import AREA_STYLES, DISC, draw_groups, draw_open_areas, spread
from tests.helpers import labels, texts


def test_groups_are_colored_by_direction_and_long_ones_named(axes: Axes) -> None:
    along = np.column_stack([np.linspace(2, 8, 7), np.full(7, 2.0)])
    draw_groups(axes, [("E1", 1, along), ("N1", 0, along[:1]), ("E2", 1, along[:0]), ("E3", 1, along[:6])])
    assert labels(axes) == ["northward", "eastward"]
    assert texts(axes) == ["E1"]  # E3 would be written over it


def test_open_areas_are_numbered_by_state(axes: Axes) -> None:
    states = list(AREA_STYLES)
    draw_open_areas(axes, np.array([(2.0, 2.0), (8.0, 2.0), (2.0, 8.0), (8.0, 8.0)]), [1, 2, 3, 4], states)
    assert sorted(texts(axes)) == ["1", "2", "3", "4"]
    assert len(set(labels(axes))) == 4


def test_discs_are_moved_apart_and_lone_ones_stay() -> None:
    places = np.array([(0.0, 0.0), (0.0, 0.0), (1.0, 0.0), (100.0, 50.0)])
    moved = spread(places, DISC)
    off = np.hypot(*(moved[:, None] - moved[None]).T)
    assert off[np.triu_indices(4, 1)].min() > 0.99 * DISC
    np.testing.assert_allclose(moved[3], places[3], atol=0.01)


def test_nothing_to_draw_draws_nothing(axes: Axes) -> None:
    draw_groups(axes, [])
    draw_open_areas(axes, np.zeros((0, 2)), [], [])
    assert labels(axes) == []
