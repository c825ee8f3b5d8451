"""Fixtures of the command lines."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import pytest

Refused = Callable[[Callable[..., int], Sequence[Any]], str]


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Refused:
    """Return what runs a command line that refuses its arguments, and returns the one line that it says."""

    def run(main: Callable[..., int], arguments: Sequence[Any]) -> str:
        assert main([str(argument) for argument in arguments]) == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        return said

    return run
