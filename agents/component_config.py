"""The base of the settings of an agent's components: frozen, checked when made, and packed for compiled kernels."""

from __future__ import annotations

from collections import namedtuple
from dataclasses import astuple, dataclass, fields
from typing import Any

from cyclic_env.validation import check_integer, check_number

MOST = 10_000
"""Greatest value of a whole number."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ComponentConfig:
    """The tuned numbers of one component; lengths in metres, angles in radians, times in seconds.

    Raises
    ------
    ConfigError
        If a value is not a finite number of at least 0, or not a whole number although the default is one.
    """

    def __post_init__(self) -> None:
        for field in fields(self):
            if isinstance(field.default, int):
                check_integer(self, field.name, 0, MOST)
            else:
                check_number(self, field.name, 0.0)


def kernel_tuple(name: str, config: type[ComponentConfig], module: str) -> Any:
    """Return a named-tuple class with the fields of a config, as which compiled kernels take its values.

    Assign it to the module-level `name` in `module`: the cache of compiled kernels looks for it there.
    """
    return namedtuple(name, [field.name for field in fields(config)], module=module)


def pack(kind: Any, config: ComponentConfig) -> Any:
    """Return the values of a config as a `kernel_tuple`."""
    return kind._make(astuple(config))
