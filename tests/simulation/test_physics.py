"""The physics: robots stay in free space, slide along walls, and drive as wheels do."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely

from cyclic_env.config import RobotConfig
from cyclic_env.floor_plans import FloorPlan, load_floor_plan
from cyclic_env.simulation.physics import WORLD_SIZE_MAX, Simulation

ROBOT = RobotConfig()
STEPS, ROBOTS = 4000, 32
"""Together 128,000 steps on every plan; `scripts/benchmark.py --walls` takes a million."""


def drive(simulation: Simulation, commands: np.ndarray) -> None:
    for world in simulation.worlds:
        simulation.drive_world(world, commands)


def place_at(plan: FloorPlan, *poses: tuple[float, float, float]) -> Simulation:
    simulation = Simulation(ROBOT, [plan], len(poses))
    for row, pose in enumerate(poses):
        simulation.place(row, 0, pose)
    return simulation


def test_no_robot_leaves_free_space_or_sinks_into_a_wall(plan: FloorPlan) -> None:
    simulation = place_at(plan, *[plan.start] * ROBOTS)
    rng = np.random.default_rng(0)
    boundary = plan.free_space.boundary
    for geometry in (boundary, plan.free_space):
        shapely.prepare(geometry)
    contacts, clearance = 0, math.inf
    commands = np.zeros((ROBOTS, 2))
    for step in range(STEPS):
        if step % 15 == 0:
            commands = 1.2 * rng.choice([-1.0, 0.5, 1.0, 1.0, 1.0], (ROBOTS, 2))
        drive(simulation, commands)
        contacts += int(simulation.drive["contact"].sum())
        if step % 2 == 0:
            x, y = simulation.drive["x"], simulation.drive["y"]
            assert shapely.contains_xy(plan.free_space, x, y).all()
            clearance = min(clearance, float(shapely.distance(shapely.points(x, y), boundary).min()))
    assert contacts > 1000
    assert clearance >= ROBOT.radius - 0.06


def test_a_robot_slides_along_a_wall_and_keeps_its_tangential_speed(square_room: FloorPlan) -> None:
    simulation = place_at(square_room, (9.7, 1.0, math.radians(60)))  # towards the east wall, 30 degrees off it
    for _ in range(15):
        drive(simulation, np.array([[1.0, 1.0]]))
    before = simulation.drive["y"][0]
    drive(simulation, np.array([[1.0, 1.0]]))
    assert simulation.drive["contact"][0]
    assert simulation.drive["y"][0] - before == pytest.approx(math.sin(math.radians(60)) * 0.2, rel=1e-3)


def test_walls_have_no_ends_for_a_sliding_robot_to_catch_on() -> None:
    corners = [(x / 2, 0.0) for x in range(81)]
    plan = FloorPlan("jointed", shapely.Polygon([*corners, (40, 2), (0, 2)]), (1, 1, 0))
    simulation = place_at(plan, (1.0, 0.3, math.radians(-20)))
    speeds = []
    for _ in range(100):
        x = simulation.drive["x"][0]
        drive(simulation, np.array([[1.0, 1.0]]))
        speeds.append(simulation.drive["x"][0] - x)
    assert min(speeds[10:]) == pytest.approx(math.cos(math.radians(20)) * 0.2, rel=1e-3)


def test_robots_pass_through_each_other(square_room: FloorPlan) -> None:
    simulation = place_at(square_room, (3.0, 5.0, 0.0), (7.0, 5.0, math.pi))
    for _ in range(20):
        drive(simulation, np.full((2, 2), 1.0))
        assert not simulation.drive["contact"].any()
    assert simulation.drive["x"][0] > simulation.drive["x"][1]


def test_travel_is_signed_along_the_heading(square_room: FloorPlan) -> None:
    simulation = place_at(square_room, (5.0, 5.0, math.pi / 2))
    for _ in range(10):
        drive(simulation, np.array([[-1.0, -1.0]]))
    assert simulation.drive["travel"][0] == pytest.approx(-0.2, rel=1e-5)
    assert simulation.drive["y"][0] < 4


def test_wheels_reach_their_speed_with_a_lag_and_turn_the_robot_as_the_axle_says(square_room: FloorPlan) -> None:
    simulation = place_at(square_room, (5.0, 5.0, 0.0))
    drive(simulation, np.array([[-0.2, 0.2]]))
    assert simulation.drive["right"][0] == pytest.approx(0.2 * (1 - math.exp(-0.2 / 0.15)))
    headings = []
    for _ in range(20):
        drive(simulation, np.array([[-0.2, 0.2]]))
        headings.append(simulation.drive["angle"][0])
    assert headings[-1] - headings[-2] == pytest.approx(2 * 0.2 / 0.4 * 0.2)


def test_a_row_placed_anew_drives_as_in_a_fresh_simulation(square_room: FloorPlan) -> None:
    used = place_at(square_room, *[(9.0, 9.0, 0.8)] * 3)
    for _ in range(50):
        drive(used, np.full((3, 2), 1.2))
    assert used.drive["contact"].all()
    used.place(1, 0, (9.0, 2.0, -0.7))
    fresh = place_at(square_room, (9.0, 2.0, -0.7))
    for _ in range(200):
        drive(used, np.full((3, 2), 1.2))
        drive(fresh, np.full((1, 2), 1.2))
        assert used.drive[1] == fresh.drive[0]


def test_spaces_hold_few_robots_and_go_when_the_last_one_leaves(square_room: FloorPlan) -> None:
    other = FloorPlan("other", shapely.box(0, 0, 5, 5), (2, 2, 0))
    simulation = Simulation(ROBOT, [square_room, other], 300)
    for row in range(300):
        simulation.place(row, 0, square_room.start)
    sizes = [len(world.body_of) for world in simulation.worlds]
    assert sum(sizes) == 300
    assert max(sizes) <= WORLD_SIZE_MAX
    for row in range(300):
        simulation.place(row, 1, other.start)
    assert {world.plan for world in simulation.worlds} == {other}
    assert len(simulation.worlds) == len(sizes)


def test_a_space_that_was_left_serves_as_a_new_one() -> None:
    plans = [load_floor_plan("ring"), load_floor_plan("figure_eight")]
    used = Simulation(RobotConfig(), plans, 1)
    commands = np.array([[1.0, 0.8]])
    tracks = []
    for plan in (0, 1, 0):
        used.place(0, plan, plans[plan].start)
        (world,) = used.worlds
        drives = []
        for _ in range(60):
            used.drive_world(world, commands)
            drives.append(used.drive.copy())
        tracks.append((world, np.array(drives).tobytes()))
    assert tracks[0][0] is tracks[2][0]
    assert tracks[0][1] == tracks[2][1]
