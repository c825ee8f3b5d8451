"""Checks of the arrays that users pass to the functions on trajectories."""

from __future__ import annotations

from typing import Any

import numpy as np

from cyclic_env.errors import ConfigError
from cyclic_env.validation import as_array


def finite_rows(value: Any, columns: int, what: str) -> np.ndarray:
    """Return `value` as finite float64 numbers `(n, columns)`; `what` names it in the error.

    Raises
    ------
    ConfigError
        If it has another shape, or holds anything but finite numbers.
    """
    expected = f"finite numbers in {columns} columns"
    array = as_array(value, what, expected, ConfigError).astype(np.float64)
    if array.ndim != 2 or array.shape[1] != columns or not np.isfinite(array).all():
        raise ConfigError(f"{what}: got an array of shape {array.shape}; expected {expected}.")
    return array


def finite_column(value: Any, what: str) -> np.ndarray:
    """Return `value` of shape `(n,)` or `(n, 1)` as finite float64 numbers `(n,)`; raises as `finite_rows` does."""
    return finite_rows(np.reshape(value, (-1, 1)), 1, what)[:, 0]
