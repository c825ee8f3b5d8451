"""The report on the paper: runs and what is kept of them, recognition on a second lap, tables, figures, resuming."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from agents.exploration.frontiers import OpenArea
from agents.knn.similarity import MEASURES
from cyclic_env.config import NOISE_PRESETS
from scripts.paper import figures, report
from scripts.paper import store as storage
from scripts.paper.experiments import Scope, differences, intervals, score
from scripts.paper.recognition import BEAMS, SEARCHES, SECTORS, SecondLap, centres_found, curve_scores, found_shares
from scripts.paper.report import GOLDEN_FIRST, TABLE_1, Reproduction, table_1_of
from scripts.paper.runs import RunRecord, RunSettings, drive_again, run_explorer, scaled_noise
from scripts.paper.store import Store
from scripts.paper.timing import search_growth
from tests.helpers import load_script

reproduce = load_script("reproduce_paper")

TINY = Scope(
    starts=1, maps=("ring", "figure_eight"), building="ring", variations=1, noise_scales=(0.5,), laps=2, repeats=3
)


@pytest.fixture(scope="module")
def eight() -> RunRecord:
    """Return the record of an exploration of two loops."""
    return run_explorer(RunSettings(map="figure_eight", preset="extended"))


@pytest.fixture(scope="module")
def lap(eight: RunRecord) -> SecondLap:
    return SecondLap(eight)


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a tiny reproduction, with its documentation in ``docs``."""
    folder = tmp_path_factory.mktemp("paper")
    Reproduction(scope=TINY, folder=folder, processes=1, docs=folder / "docs").run()
    return folder


# Runs.


def test_noise_is_scaled_but_for_its_correlation_length() -> None:
    half = scaled_noise("poor", 0.5)
    assert half.laser_short == 0.5 * NOISE_PRESETS["poor"].laser_short
    assert half.compass_field_length == NOISE_PRESETS["poor"].compass_field_length
    assert scaled_noise("poor", 0.0) == replace(NOISE_PRESETS["ideal"])


def test_a_path_driven_again_returns_at_the_rows_of_its_second_lap(eight: RunRecord, lap: SecondLap) -> None:
    again, count = lap.record, len(eight.step)
    assert len(again.step) == len(again.features) == len(again.path) == 2 * count
    assert lap.returns.any(axis=1).mean() > 0.95
    assert np.hypot(*(again.position[count:] - again.position[:count]).T).max() < 0.6
    assert set(again.group[count:]).isdisjoint(again.group[:count])


def test_a_path_along_a_wall_can_be_driven_again(eight: RunRecord) -> None:
    trajectory = eight.trajectory.copy()
    trajectory[:, :2] = trajectory[0, :2] + (0.85, 0.0)  # 0.15 m off the wall
    assert len(drive_again(replace(eight, trajectory=trajectory), 3).step) == 3 * len(eight.step)


def test_open_areas_of_a_run_are_counted(eight: RunRecord) -> None:
    states = [OpenArea(0, 0, np.zeros(2)).state, "visited"]
    scores = score(replace(eight, metrics={**eight.metrics, "area_states": states}))
    assert (scores["areas"], scores["areas_open"]) == (2, 1)


# Recognition.


def test_answers_are_the_nearest_candidates_that_a_search_allows(lap: SecondLap) -> None:
    record, n = lap.record, lap.rows
    distances = lap.distances(MEASURES["cityblock"], SECTORS)
    found, least = lap.answers(distances, "points")
    assert (least == distances.min(axis=1)).all()
    for search in SEARCHES[1:]:
        found, _ = lap.answers(distances, search)
        assert (found >= 0).any()
        assert (record.direction[n:] == record.direction[found])[found >= 0].all()
    offsets = record.position[n:] - record.position[found]
    assert np.abs(offsets[found >= 0]).max() < 2.5


def test_position_finds_what_appearance_misses_without_noise(lap: SecondLap) -> None:
    frame = pd.DataFrame(found_shares(lap)).set_index(["search", "vectors", "measure"]).found
    assert frame["direction, vote, position", SECTORS, "cosine"] > 0.95
    assert frame["points", SECTORS, "cosine"] < frame["points", BEAMS, "cosine"]


def test_scores_of_a_curve_are_those_by_hand() -> None:
    distance, right = np.array([0.1, 0.2, 0.3, np.inf]), np.array([True, False, True, False])
    found = curve_scores(distance, right, returning=4)
    assert found == {"average_precision": pytest.approx((1 + 2 / 3) / 4), "recall_at_99_precision": 0.25}
    assert curve_scores(distance, np.zeros(4, bool), 4)["average_precision"] == 0


def test_a_groups_position_tells_it_from_others(lap: SecondLap) -> None:
    found = centres_found(lap, MEASURES["cosine"])
    assert found["position"] == 1
    assert 0 < found["appearance"] <= 1


# Statistics and times.


def test_there_is_no_interval_of_fewer_than_five() -> None:
    frame = pd.DataFrame({"key": [*"aaaa", *"bbbbb"], "value": np.arange(9.0)})
    entries = intervals(frame, ("key",), "value")
    assert np.isnan(entries.loc["a", "low"])
    assert entries.loc["b", "low"] < entries.loc["b", "mean"] == 6.0 < entries.loc["b", "high"]


def test_differences_are_paired_by_start() -> None:
    rows = [
        {"explorer": name, "noise": "calibrated", "seed": seed, "cycles_closed": seed + more, "false_claims": 0.0}
        | {"coverage": 1.0}
        for name, more in (("both", 2), ("position", 1), ("appearance", 0))
        for seed in (3, 1, 2, 0, 4)
    ]
    frame = differences(pd.DataFrame(rows)).set_index(["against", "metric"])
    assert frame.loc[("position", "cycles_closed"), ["mean", "low", "high"]].tolist() == [1, 1, 1]
    assert frame.loc[("appearance", "cycles_closed"), "mean"] == 2


def test_groups_need_fewer_comparisons_than_points(eight: RunRecord) -> None:
    growth = search_growth(eight, laps=3)
    assert (growth.groups < growth.direction).all()
    assert (growth.direction < growth.points).all()


@pytest.mark.parametrize("v", GOLDEN_FIRST)
def test_five_pairs_of_whole_numbers_give_table_1(v: int) -> None:
    assert table_1_of(v) == {name: pytest.approx(value, abs=6e-4) for name, value in TABLE_1.items()}


# The report.


def test_the_report_has_its_numbers_figures_and_tables(tiny: Path) -> None:
    text = (tiny / "report.md").read_text()
    assert not re.search(r"\bnan\b|\{\{|\}\}", text)
    pictures = re.findall(r"!\[.*?\]\((.*?)\)", text)
    assert len(pictures) == len(set(pictures)) == 9
    for picture in pictures:
        assert (tiny / picture).stat().st_size > 1000
        assert (tiny / picture).with_suffix(".pdf").stat().st_size > 1000
    headline = pd.read_csv(tiny / "headline.csv")
    assert len(headline) == 2 * 4 * TINY.starts
    assert {path.stem for path in tiny.glob("*.csv")} >= {"plans", "recognition", "centres", "variations", "noise"}


def test_the_documentation_is_small_and_complete(tiny: Path) -> None:
    docs = tiny / "docs"
    pictures = {docs / name for name in re.findall(r"!\[.*?\]\((.*?)\)", (docs / "paper.md").read_text())}
    assert pictures <= set((docs / "paper").glob("*.png"))
    assert sum(picture.stat().st_size for picture in pictures) < 800_000
    with Image.open(next(iter(pictures))) as image:
        assert image.width <= figures.SMALL_WIDTH


def test_a_second_reproduction_runs_nothing_and_says_the_same(tiny: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def never(*_: Any, **__: Any) -> Any:
        raise AssertionError("this was worked out before")

    before = (tiny / "report.md").read_text()
    monkeypatch.setattr(storage, "run_explorer", never)
    Reproduction(scope=TINY, folder=tiny, processes=1).run()
    assert (tiny / "report.md").read_text() == before


# Resuming and bad input.


def test_other_code_is_another_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ran: list[RunSettings] = []
    run = RunSettings(map="ring", preset="extended")

    def counted(settings: RunSettings) -> RunRecord:
        ran.append(settings)
        return run_explorer(settings)

    monkeypatch.setattr(storage, "run_explorer", counted)
    for code in ("one", "one", "two"):
        monkeypatch.setattr(storage, "code_version", lambda code=code: code)
        Store(tmp_path, 1).run_all([run])
    assert len(ran) == 2


def test_runs_in_other_processes_are_kept(tmp_path: Path) -> None:
    runs = [RunSettings(map="ring", preset="extended"), RunSettings(map="ring", preset="extended", noise="calibrated")]
    store = Store(tmp_path, 2)
    store.run_all(runs)
    assert [store.record(run).metrics["is_success"] for run in runs] == [True, True]


def test_an_interrupt_keeps_what_was_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    count = 0

    def interrupted(settings: RunSettings) -> RunRecord:
        nonlocal count
        count += 1
        if count == 2:
            raise KeyboardInterrupt
        return run_explorer(settings)

    monkeypatch.setattr(storage, "run_explorer", interrupted)
    monkeypatch.setattr(reproduce, "PAPER", TINY)
    assert reproduce.main(["--processes", "1", "--out", str(tmp_path)]) == 130
    assert "kept" in capsys.readouterr().err
    monkeypatch.setattr(storage, "run_explorer", run_explorer)
    assert report.Store(tmp_path / "cache", 1).missing(report.experiments.all_runs(TINY)) != []
