"""Trajectories: dead reckoning on ways known on paper, errors that evo finds too, files that read back."""

from __future__ import annotations

import math
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from agents.slam.pose_graph import optimize
from agents.slam.se2 import compose, relative
from cyclic_env import ConfigError
from cyclic_env.trajectory.dead_reckoning import dead_reckon
from cyclic_env.trajectory.io import write_g2o, write_tum
from cyclic_env.trajectory.metrics import align_rigid, ate
from tests.helpers import refused

RNG = np.random.default_rng(0)


def unit(headings: np.ndarray) -> np.ndarray:
    return np.stack([np.cos(headings), np.sin(headings)], axis=1)


def turned(positions: np.ndarray, angle: float) -> np.ndarray:
    return positions @ np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])


def wandering(n: int) -> np.ndarray:
    """Return poses `(n, 3)` of a smooth way."""
    headings = np.cumsum(RNG.normal(0, 0.1, n))
    return np.column_stack([np.cumsum(0.2 * unit(headings), axis=0), np.mod(headings + np.pi, 2 * np.pi) - np.pi])


def test_dead_reckoning_adds_up_straight_ways() -> None:
    headings = np.array([0.0, 0.0, np.pi / 2, np.pi / 2])
    poses = dead_reckon([0.0, 2.0, 2.0, 5.0], unit(headings), (1.0, 1.0))
    assert poses == pytest.approx(np.array([[1, 1, 0], [3, 1, 0], [3, 1, np.pi / 2], [3, 4, np.pi / 2]]))


def test_dead_reckoning_of_an_arc_goes_along_its_chords() -> None:
    angles = np.linspace(0, 4 * np.pi, 101)  # twice around a circle of radius 5, across the seam at 180 degrees
    poses = dead_reckon(5 * angles, unit(angles + np.pi / 2))
    arc_over_chord = (angles[1] / 2) / math.sin(angles[1] / 2)
    assert poses[:, :2] == pytest.approx(arc_over_chord * (5 * unit(angles) - [5, 0]), abs=1e-9)


def test_driving_back_and_a_single_reading_are_dead_reckoned() -> None:
    assert dead_reckon([[0.0], [-1.0]], unit(np.zeros(2)))[-1] == pytest.approx([-1, 0, 0])
    assert dead_reckon([7.0], unit(np.zeros(1)), (2, 3)) == pytest.approx(np.array([[2, 3, 0]]))


def test_error_without_and_with_alignment() -> None:
    true = wandering(200)[:, :2]
    moved = turned(true, 0.3) + np.array([4.0, -1.0])
    assert ate(true + np.array([3.0, 4.0]), true) == pytest.approx(5.0)
    assert ate(moved, true) > 1
    assert ate(moved, true, align=True) < 1e-12
    assert align_rigid(moved, true) == pytest.approx(true)
    assert ate(2 * true, true, align=True) > 0.1  # no scale is taken away


def test_alignment_is_the_best_one() -> None:
    true = wandering(100)[:, :2]
    estimated = turned(true, 0.1) + RNG.normal(0, 0.3, true.shape)
    best = ate(estimated, true, align=True)
    aligned = align_rigid(estimated, true)
    centre = true.mean(axis=0)
    for angle, shift in ((1e-3, 0.0), (-1e-3, 0.0), (0.0, 1e-3), (0.0, -1e-3)):
        assert ate(turned(aligned - centre, angle) + centre + [shift, 0], true) > best


@pytest.mark.parametrize("align", [False, True])
def test_evo_reads_the_files_and_finds_the_same_error(align: bool, tmp_path: Path) -> None:
    times, true = 0.2 * np.arange(400), wandering(400)
    estimated = np.column_stack([turned(true[:, :2], 0.05) + RNG.normal(0, 0.2, (400, 2)) + [1, 2], true[:, 2]])
    kept = np.arange(0, 400, 7)  # as of an agent that has poses at some steps only
    write_tum(tmp_path / "true.tum", times, true)
    write_tum(tmp_path / "estimated.tum", times[kept], estimated[kept])
    command = [str(Path(sys.executable).parent / "evo_ape"), "tum", "true.tum", "estimated.tum"]
    done = subprocess.run(
        [*command, *(["--align"] if align else [])],
        cwd=tmp_path,
        env={"HOME": str(tmp_path), "PATH": ""},
        capture_output=True,
        text=True,
        check=True,
    )
    found = re.search(r"rmse\s+([\d.]+)", done.stdout)
    assert found
    assert float(found[1]) == pytest.approx(ate(estimated[kept, :2], true[kept, :2], align=align), abs=2e-6)


def test_a_tum_file_has_the_heading_as_a_quaternion(tmp_path: Path) -> None:
    poses = np.array([[1.0, 2.0, 0.5], [-3.0, 4.0, -3.0]])
    write_tum(tmp_path / "a.tum", [0.0, 0.2], poses)
    rows = np.loadtxt(tmp_path / "a.tum")
    assert rows[:, 0] == pytest.approx([0.0, 0.2])
    assert rows[:, 1:3] == pytest.approx(poses[:, :2])
    assert (rows[:, 3:6] == 0).all()
    assert 2 * np.arctan2(rows[:, 6], rows[:, 7]) == pytest.approx(poses[:, 2])


def read_g2o(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return poses, ends, measured poses, information `(m, 3, 3)`, and priors (pose, heading, information)."""
    lines = [line.split() for line in path.read_text().splitlines()]
    numbers = {tag: np.array([row[1:] for row in lines if row[0] == tag], float) for tag in {row[0] for row in lines}}
    assert (numbers["VERTEX_SE2"][:, 0] == np.arange(len(numbers["VERTEX_SE2"]))).all()
    assert numbers["FIX"].tolist() == [[0]]
    edges, priors = numbers["EDGE_SE2"], numbers["EDGE_PRIOR_SE2"]
    information = np.zeros((len(edges), 3, 3))
    rows, columns = np.triu_indices(3)
    information[:, rows, columns] = information[:, columns, rows] = edges[:, 5:]
    assert (priors[:, [1, 2, 4, 5, 6, 7, 8]] == 0).all()
    return numbers["VERTEX_SE2"][:, 1:], edges[:, :2].astype(int), edges[:, 2:5], information, priors[:, [0, 3, 9]]


def graph(n: int) -> tuple[np.ndarray, list[tuple[int, int, np.ndarray, np.ndarray]], np.ndarray]:
    """Return the true poses of a graph, noisy edges with full information, and headings."""
    poses = wandering(n)
    poses -= [*poses[0, :2], 0]
    spread = np.array([[0.02, 0.005, 0], [0, 0.01, 0.002], [0, 0, 0.004]])
    edges = []
    for i, j in [*((i, i + 1) for i in range(n - 1)), (0, n - 1), (3, n - 4)]:
        measured = relative(poses[i], poses[j]) + spread @ RNG.standard_normal(3)
        edges.append((i, j, measured, np.linalg.inv(spread @ spread.T)))
    return poses, edges, poses[:, 2] + RNG.normal(0, 0.05, n)


def test_a_graph_reads_back_to_the_bit(tmp_path: Path) -> None:
    poses, edges, headings = graph(20)
    write_g2o(tmp_path / "a.g2o", poses, edges, 400.0, headings)
    again, ends, measured, information, priors = read_g2o(tmp_path / "a.g2o")
    assert (again == poses).all()
    assert ends.tolist() == [[i, j] for i, j, *_ in edges]
    assert (measured == [edge[2] for edge in edges]).all()
    assert information == pytest.approx(np.array([edge[3] for edge in edges]))
    assert (priors == np.column_stack([np.arange(20), headings, np.full(20, 400.0)])).all()


def test_the_file_holds_the_problem_whose_least_squares_the_explorer_takes(tmp_path: Path) -> None:
    poses, edges, headings = graph(20)
    first = np.column_stack([poses[:, :2] + RNG.normal(0, 0.1, (20, 2)) * (np.arange(20) > 0)[:, None], poses[:, 2]])
    ends, measured = np.array([edge[:2] for edge in edges]), np.array([edge[2] for edge in edges])
    weights = np.array([edge[3] for edge in edges])
    best = optimize(first, ends, measured, weights, headings, np.full(20, 400.0))
    write_g2o(tmp_path / "a.g2o", best, edges, 400.0, headings)

    def cost(poses: np.ndarray) -> float:
        _, ends, measured, information, priors = read_g2o(tmp_path / "a.g2o")
        error = relative(poses[ends[:, 0]], poses[ends[:, 1]]) - measured
        turns = np.mod(poses[:, 2] - priors[:, 1] + np.pi, 2 * np.pi) - np.pi
        error[:, 2] = np.mod(error[:, 2] + np.pi, 2 * np.pi) - np.pi
        return float(np.einsum("ni,nij,nj->", error, information, error) + (priors[:, 2] * turns**2).sum())

    least = cost(best)
    # So many residuals, less the poses that were free: chi-squared with 3 * 21 + 20 - 3 * 19 degrees of freedom.
    assert 5 < least < 60
    for _ in range(30):
        moved = best + RNG.normal(0, 1e-3, best.shape) * (np.arange(20) > 0)[:, None]
        assert cost(moved) > least
    assert compose(best[0], relative(best[0], best[5])) == pytest.approx(best[5])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda path: ate(np.full((2, 2), np.nan), np.zeros((2, 2))), "finite numbers"),
        (lambda path: dead_reckon([0.0], np.zeros((2, 2))), "1 distances and 2 compass"),
        (lambda path: write_tum(path, [0.0], np.zeros((1, 2))), "poses: got an array of shape"),
        (lambda path: write_tum(path.parent, [0.0], np.zeros((1, 3))), "can't write to"),
        (lambda path: write_g2o(path, np.zeros((1, 3)), [(0, 1, np.zeros(3), np.eye(3))]), "joins poses 0 and 1"),
    ],
)
def test_bad_input_gets_one_line(call: object, message: str, tmp_path: Path) -> None:
    assert callable(call)
    with refused(message, ConfigError):
        call(tmp_path / "file")
