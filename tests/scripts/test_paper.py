"""The reproduction of the paper: truth, curves, times, thresholds and figures, a tiny report, resuming, interrupts."""

from __future__ import annotations

import math
import re
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from agents.knn.config import preset
from agents.knn.loop_detector import AppearanceDetector
from agents.knn.policy import KnnPolicy
from agents.knn.similarity import MEASURES
from agents.slam.keyframes import Keyframes
from agents.slam.tracker import DeadReckoningTracker
from cyclic_env import CyclicLoopEnv, load_floor_plan
from cyclic_env.config import NOISE_PRESETS
from cyclic_env.errors import ConfigError, CyclicLoopError
from cyclic_env.task.loop_closure import ELSEWHERE, RETURNS, TOO_SOON
from scripts.paper import cache as caching
from scripts.paper import figures
from scripts.paper.cache import Cache, code_version, run_all
from scripts.paper.recognition import Answers, answers_curve, ask, bootstrap_means, curve, scores, votes
from scripts.paper.report import report_text
from scripts.paper.reproduction import Reproduction
from scripts.paper.runs import (
    RunRecord,
    RunSettings,
    drive_again,
    scaled_noise,
)
from scripts.paper.sections import AGAIN, EXPLORER, GOLDEN, TABLE_1, Scope, second_lap
from scripts.paper.timing import search_growth
from tests.helpers import load_script

reproduce = load_script("reproduce_paper")

TINY = Scope(
    name="tiny",
    building="ring",
    maps=("ring",),
    seeds=1,
    varied_maps=("ring",),
    neighbours=(4,),
    sectors=(7,),
    reaches=(12.0,),
    thresholds=(0.99,),
    noise_maps=("ring",),
    noise_scales=(0.0, 1.0),
    noise_seeds=1,
    laps=2,
    repeats=3,
)
EIGHT = RunSettings(map="figure_eight", preset="extended")


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Cache:
    return Cache(tmp_path_factory.mktemp("cache"))


@pytest.fixture(scope="module")
def eight(store: Cache) -> RunRecord:
    """Return the record of an exploration of two loops."""
    return store.record(EIGHT)


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a tiny reproduction, with its documentation in ``docs``."""
    folder = tmp_path_factory.mktemp("paper")
    Reproduction(scope=TINY, folder=folder, processes=1, docs=folder / "docs").run()
    return folder


# Runs and their truth.


def test_a_run_is_kept_and_comes_back_as_it_was(store: Cache, eight: RunRecord) -> None:
    again = store.load(EIGHT)
    assert again is not None
    assert again.metrics == eight.metrics
    for name in caching.ARRAYS:
        np.testing.assert_array_equal(getattr(again, name), getattr(eight, name))


def test_the_truth_of_rows_is_how_the_environment_judges_claims(eight: RunRecord) -> None:
    for claim in eight.claims:
        row, match = np.flatnonzero(eight.step == claim["step"] - 1), np.flatnonzero(eight.step == claim["match"])
        if len(row) and len(match):  # a claim is judged a step after its row: some 20 cm on
            assert (eight.truth[row[0], match[0]] == RETURNS) == claim["correct"]
    assert eight.revisit.any()


def test_noise_is_scaled_but_for_its_correlation_length() -> None:
    half = scaled_noise("poor", 0.5)
    assert half.laser_short == 0.5 * NOISE_PRESETS["poor"].laser_short
    assert half.compass_field_length == NOISE_PRESETS["poor"].compass_field_length
    assert scaled_noise("poor", 1.0) == NOISE_PRESETS["poor"]
    assert scaled_noise("poor", 0.0) == replace(NOISE_PRESETS["ideal"])


def test_a_way_driven_again_returns_at_all_rows_of_its_second_lap(eight: RunRecord) -> None:
    laps, count = drive_again(eight, EIGHT, 2, noise="ideal"), len(eight.step)
    assert len(laps.step) == len(laps.features) == len(laps.path) == 2 * count
    assert laps.revisit[count + 30 :].mean() > 0.95
    assert np.hypot(*(laps.position[count:] - laps.position[:count]).T).max() < 0.6
    assert set(laps.group[count:]).isdisjoint(laps.group[:count])


def test_a_way_close_by_a_wall_can_be_driven_again(eight: RunRecord) -> None:
    """Between two steps of a robot that slides along a wall its way may be nearer to it than the robot fits."""
    plan = load_floor_plan("figure_eight")
    west, south, *_ = plan.bounds
    way = eight.way.copy()
    corner = min(plan.rings[0].tolist(), key=lambda point: math.hypot(point[0] - west, point[1] - south))
    way[:, :2] = np.array(corner) + 0.2
    laps = drive_again(replace(eight, way=way), EIGHT, 3, noise="ideal")
    assert laps.features[len(eight.step) :].min() == 0


# Recognition.


def test_a_curve_takes_equal_distances_together() -> None:
    thresholds, precision, recall = curve(np.array([1.0, 0.5, 1.0, 2.0]), np.array([True, True, False, True]), 4)
    assert thresholds.tolist() == [0.5, 1.0, 2.0]
    assert precision.tolist() == [1.0, 2 / 3, 3 / 4]
    assert recall.tolist() == [0.25, 0.5, 0.75]


def test_scores_of_a_curve_are_those_by_hand() -> None:
    found = scores(np.array([1.0, 0.5]), np.array([0.5, 1.0]))
    assert found == {"area": 0.75, "f1": pytest.approx(2 / 3), "recall_100": 0.5, "recall_99": 0.5}
    assert scores(np.zeros(0), np.zeros(0))["area"] == 0


def test_answers_that_are_neither_right_nor_wrong_count_neither_way() -> None:
    outcome = np.array([RETURNS, TOO_SOON, ELSEWHERE])
    answers = Answers(np.array([0.1, 0.2, 0.3]), outcome, np.zeros(3), outcome == RETURNS, 1)
    assert [values.tolist() for values in answers_curve(answers)] == [[0.1, 0.3], [1.0, 0.5], [1.0, 1.0]]


@pytest.mark.parametrize("same_direction", [False, True])
def test_candidates_are_old_enough_and_of_the_direction(eight: RunRecord, same_direction: bool) -> None:
    answers, pairs = ask(eight, "cosine", "7 sectors", same_direction=same_direction)
    count = 0
    for i in range(1, len(eight.step)):
        old = eight.path[:i] <= eight.path[i] - 20
        if same_direction:
            old &= (eight.direction[:i] == eight.direction[i]) & (eight.group[:i] != eight.group[i])
        count += int((old & (eight.truth[i, :i] != TOO_SOON)).sum())
    assert len(pairs.distance) == count
    assert len(answers.distance) <= len(eight.step)
    assert answers.revisits == eight.revisit.sum()


def test_votes_are_what_the_explorers_detector_decides(eight: RunRecord) -> None:
    config = preset("paper", threshold=-1.0)
    queries, found, _ = votes(eight, "cosine")
    detector, places, decided = AppearanceDetector(config), Keyframes(1, 7), {}
    for i in range(len(eight.step)):
        columns = {name: getattr(eight, name)[i] for name in ("direction", "group", "step", "path")}
        places.add(features=eight.features[i], **columns)
        visited = detector.detect(places, DeadReckoningTracker(), np.zeros(i + 1)).visited
        if visited is not None:
            decided[i] = visited
    assert decided == dict(zip(queries.tolist(), found.tolist(), strict=True))


def test_intervals_hold_the_mean_and_are_drawn_alike_for_all_measures() -> None:
    values = np.random.default_rng(0).uniform(size=(12, 1)) + np.array([0.0, 0.25])
    drawn = bootstrap_means(values)
    low, high = np.percentile(drawn[:, 0], (2.5, 97.5))
    assert low < values[:, 0].mean() < high
    np.testing.assert_allclose(drawn[:, 1] - drawn[:, 0], 0.25)


# Growth of the search.


def test_tables_and_groups_are_compared_with_fewer_rows_than_points(eight: RunRecord) -> None:
    laps = drive_again(eight, EIGHT, 3, noise="ideal")
    growth = search_growth(laps, "cosine", 7)
    assert len({len(values) for values in growth.values()}) == 1
    points, direction = np.array(growth["points"]), np.array(growth["direction"])
    assert (direction < points).all()
    numbers = [i for i in range(0, len(laps.step), 7) if i in points]
    expected = [
        int(((laps.direction[:i] == laps.direction[i]) & (laps.group[:i] != laps.group[i])).sum()) for i in numbers
    ]
    assert direction.tolist() == expected


# The report.


def test_the_report_has_every_section_figure_and_table(tiny: Path) -> None:
    text = (tiny / "report.md").read_text()
    for number in range(1, 8):
        assert f"\n## {number}. " in text
    pictures = re.findall(r"!\[.*?\]\((.*?)\)", text)
    assert len(pictures) == len(set(pictures)) == 11
    for picture in pictures:
        assert (tiny / picture).stat().st_size > 1000
        assert (tiny / picture).with_suffix(".pdf").stat().st_size > 1000
    assert not re.search(r"\bnan\b", text)
    assert len(list(tiny.glob("*.csv"))) == 9
    assert "**confirmed**" in text


def test_table_1_is_in_the_report_to_three_decimals(tiny: Path) -> None:
    text = (tiny / "report.md").read_text()
    row = next(line for line in text.splitlines() if line.startswith("| the pair"))
    values = [float(cell) for cell in row.split("|")[2:-1]]
    assert values[:7] == list(TABLE_1.values())
    assert values[0] == pytest.approx(MEASURES["jaccard"].distance(*GOLDEN), abs=5e-4)


def test_the_documentation_is_small_and_complete(tiny: Path) -> None:
    docs = tiny / "docs"
    pictures = re.findall(r"!\[.*?\]\((.*?)\)", (docs / "paper.md").read_text())
    assert {docs / picture for picture in pictures} == set((docs / "paper").glob("*.png"))
    sizes = [(docs / picture).stat().st_size for picture in pictures]
    assert max(sizes) < 150_000
    assert sum(sizes) < 800_000
    with Image.open(docs / pictures[0]) as image:
        assert image.width <= figures.SMALL_WIDTH


def test_a_second_reproduction_runs_nothing_and_says_the_same(tiny: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def never(*_: Any, **__: Any) -> Any:
        raise AssertionError("this was worked out before")

    monkeypatch.setattr(caching, "run_explorer", never)
    monkeypatch.setattr("scripts.paper.reproduction.comparison_times", never)
    monkeypatch.setattr("scripts.paper.reproduction.search_growth", never)
    cache = Cache(tiny / "cache")
    results = Reproduction(scope=TINY, folder=tiny, processes=1).results(cache, second_lap(cache, TINY))
    assert report_text(results) == (tiny / "report.md").read_text()


def test_rows_are_named_alike_everywhere(tiny: Path) -> None:
    assert f"### Rows {EXPLORER}" in (tiny / "report.md").read_text()
    assert f"### Rows {AGAIN}" in (tiny / "report.md").read_text()


# Resuming, damage and interrupts.


def test_what_was_run_is_not_run_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ran: list[RunSettings] = []
    original = caching.run_explorer
    monkeypatch.setattr(caching, "run_explorer", lambda settings: (ran.append(settings), original(settings))[1])
    runs = [RunSettings(map="ring"), RunSettings(map="ring", seed=1, noise="calibrated"), RunSettings(map="ring")]
    interrupted = run_all(Cache(tmp_path), runs, 1)
    assert [next(interrupted), next(interrupted)] == [(0, 2), (1, 2)]
    assert list(run_all(Cache(tmp_path), runs, 1)) == [(1, 2), (2, 2)]
    assert len(ran) == 2
    for file in tmp_path.glob("run-*.npz"):
        file.write_bytes(file.read_bytes()[:200])  # damaged
    assert list(run_all(Cache(tmp_path), runs, 1)) == [(0, 2), (1, 2), (2, 2)]


def test_other_code_or_another_threshold_is_another_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store, paper = Cache(tmp_path), RunSettings(map="ring")
    file = store._run_file(paper)
    monkeypatch.setattr("agents.knn.config.calibrated_thresholds", lambda detector: {"cosine": 0.5})
    assert store._run_file(paper) != file
    assert store._run_file(EIGHT) == store._run_file(RunSettings(**asdict(EIGHT)))
    monkeypatch.undo()
    assert store._run_file(paper) == file
    monkeypatch.setattr(caching, "code_version", lambda: "other")
    assert store._run_file(paper) != file
    assert code_version() != "other"


def test_results_depend_on_the_engine_the_plans_and_the_libraries_but_not_on_what_shows_them() -> None:
    files = {file.relative_to(caching.ROOT).as_posix() for name in caching.SOURCES for file in caching.ROOT.glob(name)}
    assert {
        "cyclic_env/engine/engine.py",
        "cyclic_env/floor_plans/io.py",
        "maps/ring.yaml",
        "agents/knn/loop_detector.py",
    } <= files
    assert files >= set(caching.SHOWING)
    assert "pymunk" in caching.LIBRARIES


def test_a_run_that_fails_in_another_process_is_one_error(tmp_path: Path) -> None:
    with pytest.raises(CyclicLoopError, match="Did you mean 'ring'"):
        list(run_all(Cache(tmp_path), [RunSettings(map="rin"), RunSettings(map="rin", seed=1)], 2))


def test_ctrl_c_leaves_one_line_and_what_was_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    original = caching.run_explorer

    def interrupted(settings: RunSettings) -> RunRecord:
        if list((tmp_path / "cache").glob("run-*")):
            raise KeyboardInterrupt
        return original(settings)

    monkeypatch.setattr(caching, "run_explorer", interrupted)
    monkeypatch.setattr(reproduce, "QUICK", TINY)
    assert reproduce.main(["--quick", "--processes", "1", "--out", str(tmp_path)]) == 130
    said = capsys.readouterr()
    assert said.err.strip() == "reproduce_paper.py: stopped; what was worked out is kept, and used next time."
    assert len(list((tmp_path / "cache").glob("run-*.npz"))) == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--processes", "0"], "--processes is 0"),
        (["--processes", "100000"], "--processes is 100000"),
        (["--out", "README.md"], "can't write to"),
    ],
)
def test_bad_input_gets_one_line(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert reproduce.main(["--out", str(tmp_path), *arguments]) == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1


# What the explorer does with its switches.


def test_the_paper_compares_the_opposite_direction_where_it_is_told_to() -> None:
    found = {}
    for both in (False, True):
        places = Keyframes(1, 3)
        back = np.array([[9, 9, 9], [1, 2, 3]])
        places.add(features=back, group=0, direction=0, step=5)
        places.add(features=np.array([[1, 2, 3], [9, 9, 9]]), group=1, direction=2, step=9)
        config = preset("paper", sectors=3, both_directions=both, threshold=0.9)
        found[both] = AppearanceDetector(config).detect(places, DeadReckoningTracker(), np.zeros(2)).visited
    assert found == {False: None, True: 0}


def test_the_extended_preset_does_not_read_the_threshold() -> None:
    ends = []
    for threshold in (None, -1.0):
        env, explorer = CyclicLoopEnv("ring"), KnnPolicy(preset("extended", threshold=threshold))
        observation, info = env.reset(seed=0)
        state, ended = None, False
        while not ended:
            action, state = explorer.predict(observation, state)
            observation, _, terminated, truncated, info = env.step(action)
            ended = terminated or truncated
        ends.append({name: value for name, value in info.items() if name != "reward_terms"})
    assert ends[0] == ends[1]


def test_a_threshold_that_is_none_is_the_calibrated_one_and_others_are_checked() -> None:
    with pytest.raises(ConfigError, match="threshold is 2"):
        preset("paper", threshold=2)
