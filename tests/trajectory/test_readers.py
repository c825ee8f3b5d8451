"""Readers of what SLAM systems write: they read back what the writers wrote, and refuse what is damaged in one line."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from cyclic_env import RecordingError
from cyclic_env.trajectory.io import write_g2o, write_tum
from cyclic_env.trajectory.metrics import match_times, relation_errors
from cyclic_env.trajectory.poses import relative
from cyclic_env.trajectory.readers import read_claims, read_relations, read_trajectory
from tests.helpers import refused

POSES = np.array([[1.0, 2.0, 0.5], [3.0, 4.0, -3.0], [5.0, 1.0, 2.0], [1.0, 2.5, 0.4]])


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "file.tum"


def test_a_tum_file_reads_back(file: Path) -> None:
    write_tum(file, [0.5, 1.0, 2.0, 4.0], POSES)
    read = read_trajectory(file)
    assert read.times.tolist() == [0.5, 1.0, 2.0, 4.0]
    np.testing.assert_allclose(read.poses, POSES, atol=1e-9)


def test_a_pose_in_space_is_seen_from_above(file: Path) -> None:
    tilt, turn = math.sin(0.1), math.cos(0.1)  # tilted about its own x axis, after a quarter turn to the left
    half = math.sqrt(0.5)
    file.write_text(f"# a comment\n7.5, 1, 2, 9, {tilt * half}, {tilt * half}, {turn * half}, {turn * half}\n\n")
    np.testing.assert_allclose(read_trajectory(file).poses, [[1, 2, math.pi / 2]], atol=1e-9)


def test_the_vertices_and_loop_edges_of_a_g2o_file_are_read(tmp_path: Path) -> None:
    graph = tmp_path / "graph.g2o"
    edges = [(i, j, relative(POSES[i], POSES[j]), np.eye(3)) for i, j in ((0, 1), (1, 2), (2, 3), (0, 3), (3, 1))]
    write_g2o(graph, POSES, edges)
    read, claims = read_trajectory(graph), read_claims(graph)
    assert read.times.tolist() == [0, 1, 2, 3]
    np.testing.assert_allclose(read.poses, POSES)
    assert np.column_stack([claims.times, claims.matches]).tolist() == [[3, 0], [1, 3]]
    assert claims.measured is not None
    np.testing.assert_allclose(claims.measured, [relative(POSES[0], POSES[3]), relative(POSES[3], POSES[1])])


def test_a_g2o_file_of_poses_in_space_is_read(tmp_path: Path) -> None:
    graph, quaternion = tmp_path / "graph.g2o", "0 0 0.6 0.8"
    lines = [f"VERTEX_SE3:QUAT {i} {i} 2 3 {quaternion}" for i in (4, 7, 9)]
    graph.write_text("\n".join([*lines, f"EDGE_SE3:QUAT 4 9 1 0 0 {quaternion} 1 0 0"]))
    assert read_trajectory(graph).times.tolist() == [4, 7, 9]
    assert read_claims(graph).times.tolist() == [9]
    assert read_trajectory(graph).poses[1].tolist() == pytest.approx([7, 2, 2 * math.asin(0.6)])


def test_tables_of_claims_have_the_columns_that_their_header_names(tmp_path: Path) -> None:
    table = tmp_path / "claims.csv"
    table.write_text("who, time, score, match_time\nme, 4, 0.5, 1\nyou, 5, 0.25, 2\n")
    claims = read_claims(table)
    assert (claims.times.tolist(), claims.matches.tolist(), claims.by_step) == ([4, 5], [1, 2], False)
    assert claims.scores is not None
    assert claims.scores.tolist() == [0.5, 0.25]
    table.write_text("step,match,x,y,heading\n4,1,0.5,0,3\n")
    claims = read_claims(table)
    assert (claims.by_step, claims.scores) == (True, None)
    assert claims.measured is not None
    assert claims.measured.tolist() == [[0.5, 0, 3]]
    table.write_text("step,match\n", encoding="utf-8-sig")  # as Excel writes it
    assert len(read_claims(table).times) == 0


def test_relations_are_compared_as_the_slam_benchmark_does(file: Path) -> None:
    file.write_text("0.5 2.0 1.5 0 0 0 0 0.1\n1.0 4.0 0 2 0 0 0 -0.1\n")
    times, poses = read_relations(file)
    pairs = match_times(times.ravel(), np.array([0.5, 1.0, 2.0, 4.0]), 0.01).reshape(-1, 2)
    assert pairs.tolist() == [[0, 2], [1, 3]]
    estimated = np.zeros((4, 3))
    estimated[2], estimated[3] = (1.5, 0.3, 0.1), (0.4, 2.3, 0.1)
    errors = relation_errors(estimated, pairs, poses)
    assert errors == pytest.approx((2, 0.4, 0.1, 0.1, 0.1))


def test_times_are_matched_with_the_nearest_within_the_tolerance() -> None:
    others = np.array([1.0, 2.0, 2.5])
    assert match_times(np.array([0.0, 0.95, 1.5, 2.26, 9.0]), others, 0.1).tolist() == [-1, 0, -1, -1, -1]
    assert match_times(np.array([0.0, 1.5, 2.26, 9.0]), others, 10.0).tolist() == [0, 0, 2, 2]
    assert match_times(np.array([3.0]), np.array([3.0]), 0.0).tolist() == [0]


GOOD = "1 0 0 0 0 0 0 1\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "holds no poses"),
        ("# only a comment\n", "holds no poses"),
        (GOOD + "2 0 0 0\n", "line 2 is '2 0 0 0'; expected finite numbers: timestamp"),
        (GOOD + "2 0 nan 0 0 0 0 1\n", "line 2"),
        (GOOD + "2 0 inf 0 0 0 0 1\n", "line 2"),
        ("time x y z qx qy qz qw\n" + GOOD, "line 1"),
        ("1 0 0 0 0 0 0 0\n", "quaternion of pose 0 has the length 0"),
        ("2 0 0 0 0 0 0 1\n" + GOOD, "not sorted by time: 1.000000 comes after 2"),
        (GOOD + GOOD, "not sorted by time: 1.000000 comes after 1"),
    ],
)
def test_a_damaged_trajectory_gets_one_line(text: str, message: str, file: Path) -> None:
    file.write_text(text)
    with refused(message, RecordingError):
        read_trajectory(file)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.csv", "", "header is ''"),
        ("a.csv", "a,b\n1,2\n", "header is 'a,b'; expected the columns time,match_time or step,match"),
        ("a.csv", "time,match_time\n1,2\n3\n", "row 2 is '3 None'"),
        ("a.csv", "time,match_time\n1,x\n", "row 1 is '1 x'"),
        ("a.csv", "time,match_time,score\n1,2,nan\n", "row 1"),
        ("a.csv", "step,match\n1.5,0\n", "whole numbers"),
        ("a.csv", "step,match,step\n1,0,2\n", "names a column twice"),
        ("a.csv", 'time,match_time\n1,"2\n', "no CSV table"),
        ("a.g2o", "", "holds no vertices"),
        ("a.g2o", "VERTEX_SE2 0 1\n", "line 1 is '0 1'; expected finite numbers: 4 after VERTEX_SE2"),
        ("a.g2o", "VERTEX_SE2 0 0 0 0\nEDGE_SE2 0 1 0 0 0\n", "joins the vertices 0 and 1, of which one is missing"),
    ],
)
def test_damaged_claims_get_one_line(name: str, text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    with refused(message, RecordingError):
        read_claims(tmp_path / name)


def test_what_is_no_text_file_gets_one_line(tmp_path: Path) -> None:
    (tmp_path / "a.tum").write_bytes(bytes(range(256)))
    for read in (read_trajectory, read_claims, read_relations):
        with refused("is not a text file", RecordingError):
            read(tmp_path / "a.tum")
        with refused("no such file", RecordingError):
            read(tmp_path / "missing")
        with refused("can't be read: Is a directory", RecordingError):
            read(tmp_path)
