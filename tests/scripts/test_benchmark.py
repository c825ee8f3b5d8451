"""The benchmark: its verdicts, and what it keeps."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.helpers import load_script

benchmark = load_script("benchmark")


def some_rows() -> Iterator[Any]:
    yield benchmark.Row("speed", "good", 2000.0, "x", least=1000)
    yield benchmark.Row("speed", "bad", 3.0, "s", most=1)
    yield benchmark.Row("speed", "neither", 0.5, "s")


def interrupted() -> Iterator[Any]:
    raise KeyboardInterrupt
    yield


@pytest.fixture
def stubbed(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """Put nothing in place of all measurements, and three rows in place of the first."""
    for name in vars(benchmark):
        if name.startswith("measure_"):
            monkeypatch.setattr(benchmark, name, lambda *_: iter(()))
    monkeypatch.setattr(benchmark, "measure_machine", some_rows)
    return monkeypatch


def test_benchmark_says_of_every_target_whether_it_was_met(stubbed: Any, tmp_path: Path) -> None:
    file = tmp_path / "speed.json"
    assert benchmark.main(["--json", str(file)]) == 0
    assert [row["verdict"] for row in json.loads(file.read_text())["results"]] == ["ok", "MISSED", ""]


def test_ctrl_c_in_benchmark_keeps_the_rows(stubbed: Any, tmp_path: Path) -> None:
    stubbed.setattr(benchmark, "measure_laser", interrupted)
    file = tmp_path / "speed.json"
    assert benchmark.main(["--json", str(file)]) == 130
    assert len(json.loads(file.read_text())["results"]) == 3


def test_phases_of_a_step_add_up_to_the_step() -> None:
    *phases, together = benchmark.measure_phases()
    assert {row.name.split(": ")[1] for row in phases} > {"drive (pymunk)", "laser", "rest"}
    assert all(row.value > 0 for row in phases)
    assert sum(row.value for row in phases) == pytest.approx(together.value)
