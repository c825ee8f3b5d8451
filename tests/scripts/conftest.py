"""Fixtures of the command lines."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import pytest

Refused = Callable[..., str]


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Refused:
    """Return what runs a command line that refuses its arguments, and returns the one line that it says."""

    def run(main: Callable[..., int], arguments: Sequence[Any], *, before_the_work: bool = True) -> str:
        assert main([str(argument) for argument in arguments]) == 2
        said = capsys.readouterr()
        assert said.err.count("\n") == 1
        assert not (said.out and before_the_work)
        return said.err

    return run
