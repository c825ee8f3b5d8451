"""Checks of what users pass in: names, numbers and arrays, with error messages of one line."""

from __future__ import annotations

import difflib
import math
import reprlib
from collections.abc import Collection, Iterable, Mapping
from dataclasses import fields
from numbers import Integral, Real
from typing import Any, TypeGuard, TypeVar

import numpy as np

from cyclic_env.errors import ConfigError, CyclicLoopError

T = TypeVar("T")


def short_repr(value: object) -> str:
    """Return the value on one line for an error message; large arrays and nested lists are abbreviated."""
    short = reprlib.Repr()
    short.maxlevel, short.maxstring, short.maxother = 3, 200, 200
    try:
        text = short.repr(value)
    except ValueError:  # Python refuses to print integers of more than 4,300 digits
        text = "a number with thousands of digits"
    return " ".join(text.split())


def unknown_name(kind: str, name: object, known: Iterable[str]) -> str:
    """Return the error message for an unknown name, which lists the known ones and suggests the nearest.

    Parameters
    ----------
    kind : str
        What the name should have been, such as ``"map"``.
    name : object
        The unknown name.
    known : iterable of str
        All valid names.
    """
    known = sorted(known)
    nearest = difflib.get_close_matches(name, known, n=1, cutoff=0.5) if isinstance(name, str) else []
    hint = f" Did you mean {nearest[0]!r}?" if nearest else ""
    return f"unknown {kind} {short_repr(name)}.{hint} Known: {', '.join(known) if known else 'none'}."


def is_integer(value: object) -> TypeGuard[int]:
    """Tell whether the value is an integer of Python or NumPy; a bool is not."""
    return isinstance(value, Integral) and not isinstance(value, bool)


def check_choice(kind: str, name: T, known: Collection[T]) -> T:
    """Return `name`, checked to be one of the `known` names of some `kind` of thing.

    Raises
    ------
    ConfigError
        If it isn't; the message suggests the nearest known name.
    """
    if not isinstance(name, str) or name not in known:
        raise ConfigError(unknown_name(kind, name, map(str, known)))
    return name


def as_array(value: Any, what: str, expected: str, error: type[CyclicLoopError]) -> np.ndarray:
    """Return `value` as an array of real numbers of any shape; the error says `what` it is and what was `expected`.

    Raises
    ------
    error
        If it can't be one: complex numbers, text, ragged lists, or objects such as integers beyond 64 bits.
    """
    try:
        array = np.asarray(value)
        if array.dtype.kind not in "biuf":
            raise TypeError(f"its type is {array.dtype}")
    except Exception as problem:  # other libraries' arrays raise what they like
        reason = " ".join(str(problem).split())
        raise error(f"{what} is not an array of numbers ({reason}); expected {expected}.") from problem
    return array


def check_field(owner: object, condition: bool, field: str, expected: str) -> None:
    """Raise a `ConfigError` that names the field of a settings class, unless the condition holds."""
    if not condition:
        got = short_repr(getattr(owner, field))
        raise ConfigError(f"{type(owner).__name__}.{field} is {got}; expected {expected}.")


def check_number(owner: object, field: str, low: float, high: float = math.inf, *, open_low: bool = False) -> None:
    """Check that a field of a frozen settings class is a finite number from `low` to `high`; store it as a float.

    Raises
    ------
    ConfigError
        If it isn't.
    """
    value = getattr(owner, field)
    try:
        number = float(value) if isinstance(value, Real) and not isinstance(value, bool) else math.nan
    except OverflowError:
        number = math.nan
    inside = math.isfinite(number) and (low < number if open_low else low <= number) and number <= high
    bound = f"{'more than' if open_low else 'at least'} {low:g}" + (f", at most {high:g}" if high < math.inf else "")
    check_field(owner, inside, field, f"a finite number, {bound}")
    object.__setattr__(owner, field, number)


def check_integer(owner: object, field: str, low: int, high: int) -> None:
    """Check that a field of a frozen settings class is a whole number from `low` to `high`; store it as an int.

    Raises
    ------
    ConfigError
        If it isn't.
    """
    value = getattr(owner, field)
    check_field(owner, is_integer(value) and low <= value <= high, field, f"a whole number from {low} to {high}")
    object.__setattr__(owner, field, int(value))


def check_bool(owner: object, field: str) -> None:
    """Check that a field of a frozen settings class is a bool of Python or NumPy; store it as Python's.

    Raises
    ------
    ConfigError
        If it isn't.
    """
    value = getattr(owner, field)
    check_field(owner, isinstance(value, bool | np.bool_), field, "True or False")
    object.__setattr__(owner, field, bool(value))


def from_mapping(cls: type[T], value: T | Mapping[str, Any] | None) -> T:
    """Return an instance of a settings class: `value` itself, one with its fields, or the defaults if it is None.

    Raises
    ------
    ConfigError
        If a field is unknown (the message suggests the nearest) or out of range.
    """
    if isinstance(value, cls):
        return value
    if not isinstance(value, Mapping | None):
        raise ConfigError(f"expected a {cls.__name__} or a mapping of its fields, got {type(value).__name__}.")
    known = {field.name for field in fields(cls)}  # pyright: ignore[reportArgumentType]
    for key in value or {}:
        check_choice(f"field of {cls.__name__}", key, known)
    return cls(**(value or {}))
