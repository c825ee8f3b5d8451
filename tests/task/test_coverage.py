"""Coverage: which cells count, and which of them a scan marks."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import numpy as np
import pytest
import shapely
from shapely import box

from cyclic_env import CyclicLoopEnv
from cyclic_env.config import CoverageConfig, LaserConfig, RobotConfig
from cyclic_env.floor_plans import FloorPlan, write_floor_plan
from cyclic_env.simulation.lidar import laser_beams, scan
from cyclic_env.task.coverage import build_coverage_grid, mark_scan, seen_cells, visible_share

LASER = LaserConfig()


def cells_on_beams(plan: FloorPlan, pose: np.ndarray, size: float = 0.5) -> set[tuple[int, int]]:
    """Return the cells that the beams from `pose` pass through: the plain twin, by the crossings of grid lines."""
    west, south, *_ = plan.bounds
    cells = set()
    for beam, reach in enumerate(scan(plan.walls, pose, LASER)):
        angle = pose[2] + beam * LASER.beam_spacing
        way = np.array([math.cos(angle), math.sin(angle)])
        begin = (pose[:2] - (west, south)) / size
        crossings = [0.0, reach / size]
        for axis in (0, 1):
            if abs(way[axis]) > 1e-12:
                lines = np.arange(-2, 2 + reach / size) + math.floor(begin[axis]) if way[axis] > 0 else None
                lines = lines if lines is not None else math.floor(begin[axis]) + 2 - np.arange(4 + reach / size)
                crossings += [t for t in (lines - begin[axis]) / way[axis] if 0 < t < reach / size]
        crossings.sort()
        for enter, leave in itertools.pairwise(crossings):
            if leave - enter > 1e-9:
                column, row = np.floor(begin + (enter + leave) / 2 * way).astype(int)
                cells.add((int(row), int(column)))
    return cells


def test_a_scan_marks_the_free_cells_that_its_beams_pass(plan: FloorPlan) -> None:
    grid = build_coverage_grid(plan, 1, CoverageConfig())
    rng = np.random.default_rng(0)
    inside = plan.free_space.buffer(-0.3)
    x, y = shapely.get_coordinates(inside.representative_point())[0]
    for _ in range(6):
        while True:
            x, y = rng.uniform(plan.bounds[:2], plan.bounds[2:])
            if shapely.contains_xy(inside, x, y):
                break
        pose = np.array([x, y, rng.uniform(-3, 3)])
        grid.seen[:] = False
        ranges = scan(plan.walls, pose, LASER)
        count = mark_scan(grid, 0, 0, tuple(pose), laser_beams(LASER), ranges)
        picture = seen_cells(grid, 0, 0)
        expected = {cell for cell in cells_on_beams(plan, pose) if picture[cell] >= 0}
        marked = {(int(row), int(column)) for row, column in np.argwhere(picture == 1)}
        # A beam through a corner of cells may fall to either side by a rounding.
        assert len(marked ^ expected) <= 1
        assert count == len(marked)


def test_only_cells_with_a_free_centre_count(square_room: FloorPlan) -> None:
    grid = build_coverage_grid(square_room, 1, CoverageConfig())
    assert grid.cells_total[0] == round(square_room.free_area / 0.25)


def test_what_is_seen_stays_seen_and_coverage_is_its_share() -> None:
    env = CyclicLoopEnv("ring")
    *_, info = env.reset(seed=0)
    before, coverage = env.seen_cells(), info["coverage"]
    for _ in range(30):
        *_, info = env.step(np.array([1, 1, -1, 0]))
    after = env.seen_cells()
    assert (after >= before).all()
    assert info["coverage"] > coverage
    assert info["coverage"] == (after == 1).sum() / (after >= 0).sum()


def test_a_robot_that_stands_still_marks_the_start_only_and_is_paid_in_step_1() -> None:
    env = CyclicLoopEnv("ring")
    *_, info = env.reset(seed=0)
    seen = info["coverage"]
    terms = [env.step(np.zeros(4))[-1]["reward_terms"]["coverage"] for _ in range(5)]
    assert terms == [pytest.approx(50 * seen), 0, 0, 0, 0]


def with_a_hidden_nook(side: float) -> FloorPlan:
    """Return a room of 20 m, and a square nook at the end of a bent slit that is too narrow for the robot."""
    slit = box(20, 10, 21, 10.2).union(box(20.8, 10, 21, 13))
    nook = box(21, 13 - 0.2, 21 + side, 13 - 0.2 + side)
    space = box(0, 0, 20, 20).union(slit).union(nook)
    assert isinstance(space, shapely.Polygon)
    return FloorPlan("nook", space, (5.0, 5.0, 0.0))


def test_cells_that_no_reachable_position_sees_lack_in_the_visible_share() -> None:
    share = visible_share(with_a_hidden_nook(2.4), 0.25, 12.0, CoverageConfig())
    assert share == pytest.approx(1 - 2.4**2 / (400 + 2.4**2), abs=0.004)


def test_a_file_is_warned_of_of_which_too_much_is_hidden(tmp_path: Path) -> None:
    write_floor_plan(with_a_hidden_nook(2.4), tmp_path / "nook.yaml")
    with pytest.warns(UserWarning, match=r"1\.\d% of the free cells can't be seen"):
        CyclicLoopEnv(tmp_path / "nook.yaml").close()
    CyclicLoopEnv(tmp_path / "nook.yaml", coverage={"complete": 0.95}).close()


def test_all_of_every_shipped_plan_can_be_seen(plan: FloorPlan) -> None:
    assert visible_share(plan, RobotConfig().radius, LASER.range_max, CoverageConfig()) >= 0.99
