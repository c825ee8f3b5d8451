"""The explorer's command line: what it writes, that it is true, one line for bad input, and Ctrl-C keeps the run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from agents.knn.config import preset
from agents.knn.policy import KnnPolicy
from agents.slam.se2 import relative
from cyclic_env import CyclicLoopEnv, replay
from cyclic_env.evaluation.rollout import evaluate
from cyclic_env.rendering.gif import FRAMES_MAX
from tests.helpers import load_script
from tests.scripts.conftest import Refused

run_knn = load_script("run_knn")

TRACKS = ("true", "dead_reckoned", "corrected")
FILES = {"run.png", "run.gif", "metrics.json"}


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a run on the ring."""
    out = tmp_path_factory.mktemp("knn") / "ring"
    assert run_knn.main(["--map", "ring", "--out", str(out)]) == 0
    return out


@pytest.fixture(scope="module")
def metrics(out: Path) -> dict[str, Any]:
    return json.loads((out / "metrics.json").read_text())


def test_the_ring_is_seen_and_closed_without_a_false_claim(metrics: dict[str, Any]) -> None:
    assert metrics["is_success"]
    assert (metrics["cycles_closed"], metrics["false_claims"], metrics["ending"]) == (1, 0, "success")
    assert metrics["path_over_tour"] < 1.25


def test_metrics_are_those_of_the_same_run_by_hand(metrics: dict[str, Any]) -> None:
    env, explorer = CyclicLoopEnv("ring"), KnnPolicy()
    observation, info = env.reset(seed=0)
    state, total, steps, ended = None, 0.0, 0, False
    while not ended:
        action, state = explorer.predict(observation, state)
        observation, reward, terminated, truncated, info = env.step(action)
        total, steps, ended = total + reward, steps + 1, terminated or truncated
    assert state is not None
    scalars = {name: value for name, value in info.items() if name != "reward_terms"}
    assert {name: metrics[name] for name in scalars} == scalars
    assert (metrics["steps"], metrics["return"], metrics["map"]) == (steps, total, "ring")
    assert metrics["path_over_tour"] == info["path_length_m"] / env.floor_plan.closed_tour()
    assert metrics["groups"] == len(state[0].groups)
    assert metrics["rows_compared"] == state[0].detector.compared
    assert metrics["open_areas"] == len(state[0].frontiers.listed)
    settings = ("noise", "preset", "detector", "measure", "seed", "random_start")
    assert [metrics[name] for name in settings] == ["ideal", "extended", "both", "cosine", 0, False]
    for name in ("env", "agent", "agent_median"):
        assert 0 < metrics[f"seconds_per_step_{name}"] < 10


def test_figure_and_animation_are_there_and_small(out: Path) -> None:
    assert {path.name for path in out.iterdir()} == FILES
    with Image.open(out / "run.png") as picture:
        assert picture.width == 1500
    with Image.open(out / "run.gif") as animation:
        assert 20 < getattr(animation, "n_frames", 1) <= FRAMES_MAX + 1
    assert (out / "run.gif").stat().st_size < 3e6
    assert (out / "run.png").stat().st_size < 5e5


def test_options_reach_the_run(tmp_path: Path) -> None:
    file = tmp_path / "new" / "scores.json"
    arguments = ["--map", "ring", "--preset", "paper", "--measure", "cityblock", "--noise", "typical", "--seed", "3"]
    arguments += ["--random-start", "--no-gif", "--out", str(tmp_path / "out"), "--json", str(file)]
    assert run_knn.main(arguments) == 0
    metrics = json.loads(file.read_text())
    settings = ("noise", "preset", "detector", "measure", "seed", "random_start")
    assert [metrics[name] for name in settings] == ["typical", "paper", "both", "cityblock", 3, True]
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"run.png"}


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """Return the folder of the exports of a noisy run, and its metrics."""
    out = tmp_path_factory.mktemp("export")
    arguments = ["--map", "figure_eight", "--noise", "calibrated", "--seed", "1", "--no-gif", "--out", str(out)]
    assert run_knn.main([*arguments, "--export", str(out / "files")]) == 0
    return out / "files", json.loads((out / "metrics.json").read_text())


def test_a_run_is_exported_and_replays_to_the_bit(exported: tuple[Path, dict[str, Any]]) -> None:
    folder, metrics = exported
    assert {path.name for path in folder.iterdir()} == set(run_knn.EXPORTS)
    outcome = replay(folder / "episode.npz")
    assert outcome.equal
    assert outcome.steps == metrics["steps"]
    assert outcome.info["claims"] == metrics["claims"]


def test_the_exported_tracks_are_as_far_off_as_the_metrics_say(exported: tuple[Path, dict[str, Any]]) -> None:
    folder, metrics = exported
    true, reckoned, corrected = (np.loadtxt(folder / f"{name}.tum") for name in TRACKS)
    assert len(true) == len(reckoned) == metrics["steps"] + 1
    assert len(corrected) == metrics["rows"]
    assert metrics["ate_dead_reckoning_m"] == pytest.approx(rms(reckoned, true), abs=1e-6)
    there = true[np.searchsorted(true[:, 0], corrected[:, 0])]
    assert (there[:, 0] == corrected[:, 0]).all()
    assert metrics["ate_corrected_m"] == pytest.approx(rms(corrected, there), abs=1e-6)
    assert metrics["end_error_corrected_m"] == pytest.approx(rms(corrected[-1:], there[-1:]), abs=1e-6)
    # The shape of the way is what matching scans is for; which way is north, the compass alone can tell.
    assert metrics["ate_corrected_aligned_m"] < 0.3 * metrics["ate_dead_reckoning_aligned_m"]
    for name in ("dead_reckoning", "corrected"):
        assert metrics[f"ate_{name}_aligned_m"] < metrics[f"ate_{name}_m"]


def rms(estimated: np.ndarray, true: np.ndarray) -> float:
    return float(np.sqrt(((estimated[:, 1:3] - true[:, 1:3]) ** 2).sum(axis=1).mean()))


def test_the_exported_graph_has_a_vertex_a_place_and_its_edges_fit(exported: tuple[Path, dict[str, Any]]) -> None:
    folder, metrics = exported
    lines = [line.split() for line in (folder / "pose_graph.g2o").read_text().splitlines()]
    places = np.array([line[2:] for line in lines if line[0] == "VERTEX_SE2"], float)
    edges = np.array([line[1:] for line in lines if line[0] == "EDGE_SE2"], float)
    corrected = np.loadtxt(folder / "corrected.tum")
    from_rows = np.hypot(*(places[:, None, :2] - corrected[None, :, 1:3]).T)
    assert from_rows.min(axis=1).max() < 1e-8  # every row is a vertex
    i, j = edges[:, :2].astype(int).T
    assert set(zip(range(len(places) - 1), range(1, len(places)), strict=True)) <= set(zip(i, j, strict=True))
    assert (j - i > 5).any()  # loops
    off = relative(places[i], places[j])[:, :2] - edges[:, 2:4]
    assert np.median(np.hypot(*off.T)) < 0.05
    assert metrics["rows"] <= len(places)


def test_a_plan_without_centrelines_has_no_tour_to_compare_with(tmp_path: Path) -> None:
    plan = tmp_path / "room.yaml"
    plan.write_text("name: room\nexterior: [[0, 0], [8, 0], [8, 6], [0, 6]]\nstart: {x: 2, y: 2, heading: 0}\n")
    assert run_knn.main(["--map", str(plan), "--no-gif", "--out", str(tmp_path)]) == 0
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["path_over_tour"] is None
    assert metrics["is_success"]


def test_an_explorer_with_nothing_left_to_explore_stands_for_the_rest_of_the_episode(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    predict = KnnPolicy.predict

    def content(self: KnnPolicy, *arguments: Any, **named: Any) -> Any:
        action, state = predict(self, *arguments, **named)
        if state[0].steps >= 10:
            state[0].done = True
            state[0].planner.clear_goal()
        return action, state

    monkeypatch.setattr(KnnPolicy, "predict", content)
    assert run_knn.main(["--map", "ring", "--preset", "paper", "--no-gif", "--out", str(tmp_path)]) == 0
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert (metrics["stopped_at"], metrics["ending"]) == (10, "step budget spent")
    assert metrics["path_length_m"] < 3
    (episode,) = evaluate(KnnPolicy(preset("paper")), map_name="ring", seeds=[0]).episodes
    assert [metrics[name] for name in ("steps", "return")] == [episode["steps"], pytest.approx(episode["return"])]
    assert metrics["reward_terms"] == pytest.approx(episode["reward_terms"])


@pytest.mark.parametrize("steps", [60, 0])
def test_ctrl_c_keeps_what_was_run(steps: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    step = CyclicLoopEnv.step

    def interrupted(self: CyclicLoopEnv, action: np.ndarray) -> Any:
        if len(self.trajectory()) > steps:
            raise KeyboardInterrupt
        return step(self, action)

    monkeypatch.setattr(CyclicLoopEnv, "step", interrupted)
    assert run_knn.main(["--map", "ring", "--out", str(tmp_path)]) == 130
    assert {path.name for path in tmp_path.iterdir()} == (FILES if steps else set())
    if steps:
        metrics = json.loads((tmp_path / "metrics.json").read_text())
        assert (metrics["steps"], metrics["ending"]) == (60, "interrupted")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--map", "rin"], "Did you mean 'ring'?"),
        (["--preset", "extend"], "Did you mean 'extended'?"),
        (["--measure", "cosin"], "Did you mean 'cosine'?"),
        (["--json", "OUT/run.png"], "run.png would be written twice"),
        (["--export", "README.md"], "can't write to README.md"),
    ],
)
def test_bad_input_gets_one_line(arguments: list[str], message: str, tmp_path: Path, refused: Refused) -> None:
    arguments = [argument.replace("OUT", str(tmp_path)) for argument in arguments]
    assert message in refused(run_knn.main, [*arguments, "--out", tmp_path])
