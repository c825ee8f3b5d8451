"""Measurements of the environment: laser, steps of one robot and of many, memory, start-up, walls."""

from __future__ import annotations

import math
import sys
import tempfile
import time
from collections.abc import Iterator

import gymnasium
import numpy as np
import pymunk
import shapely
from numba import njit
from shapely.affinity import scale

from cyclic_env import CyclicLoopVectorEnv, FloorPlan, load_floor_plan, map_names
from cyclic_env.config import LaserConfig, RobotConfig
from cyclic_env.simulation.lidar import laser_beams, scan, scan_row
from cyclic_env.simulation.physics import Simulation
from cyclic_env.simulation.wall_index import build_wall_index
from cyclic_env.task.path_history import allocate_memory
from scripts.speed.rows import REPEATS, Row, best_time, random_actions, rate_of, run_python

ALL_SHAPES = pymunk.ShapeFilter()

STAGES = {
    "actions": "actions",
    "drive": "drive (pymunk)",
    "judge": "mark, judge, reward, info",
    "sensors": "sensors",
    "observation": "observation",
}
"""The stages of a step that the environment times, and what the table calls them."""


@njit(error_model="numpy")  # not cached: numba can't find a script's functions when it runs under another name
def scan_all(tiles, poses, beams, scratch, ranges):
    """Scan from every pose in one call from Python."""
    for i in range(poses.shape[0]):
        scan_row(tiles, 0, (poses[i, 0], poses[i, 1], poses[i, 2]), beams, scratch, ranges[i])


def free_poses(plan: FloorPlan, count: int) -> np.ndarray:
    """Return random poses `(count, 3)` where the robot can stand."""
    rng, area = np.random.default_rng(0), plan.reachable(RobotConfig().radius)
    poses = np.empty((0, 3))
    while len(poses) < count:
        draw = rng.uniform((*plan.bounds[:2], -math.pi), (*plan.bounds[2:], math.pi), (20 * count, 3))
        poses = np.concatenate([poses, draw[shapely.contains_xy(area, draw[:, 0], draw[:, 1])]])
    return poses[:count]


def measure_machine() -> Iterator[Row]:
    """Time plain Python, so that rates of different machines, or of a busy one, can be compared."""
    yield Row("machine", "10^7 additions in a Python loop", best_time(lambda: sum(i for i in range(10**7))), "s")


def measure_laser() -> Iterator[Row]:
    """Time one scan of 180 beams on Killian Court, three ways."""
    plan, laser = load_floor_plan("killian_court"), LaserConfig()
    poses = free_poses(plan, 2000)
    tiles, beams = build_wall_index(plan, laser.range_max), laser_beams(laser)
    scratch, ranges = np.empty(2 * laser.num_beams), np.empty((len(poses), laser.num_beams))
    compiled_scan = best_time(lambda: scan_all(tiles, poses, beams, scratch, ranges)) / len(poses)
    twin = best_time(lambda: [scan(plan.walls, pose, laser) for pose in poses[:50]]) / 50
    worst = max(float(abs(scan(plan.walls, pose, laser) - ranges[i]).max()) for i, pose in enumerate(poses[:200]))

    space = pymunk.Space()
    for x1, y1, x2, y2 in plan.walls.tolist():
        space.add(pymunk.Segment(space.static_body, (x1, y1), (x2, y2), 0))

    def query() -> None:
        for x, y, heading in poses[:50]:
            for beam in range(laser.num_beams):
                angle = heading + beam * laser.beam_spacing
                end = (x + laser.range_max * math.cos(angle), y + laser.range_max * math.sin(angle))
                space.segment_query_first((x, y), end, 0, ALL_SHAPES)

    queries = best_time(query) / 50
    yield Row("laser", "z-buffer, one scan", compiled_scan * 1e6, "us")
    yield Row("laser", "NumPy twin / z-buffer", twin / compiled_scan, "x")
    yield Row("laser", "180 pymunk queries / z-buffer", queries / compiled_scan, "x", least=60)
    yield Row("laser", "largest difference from the twin", worst, "m")


def driving_actions(num_envs: int) -> np.ndarray:
    """Return actions that drive at full speed, turn now and then and run into walls, so that the robots spread out."""
    rng = np.random.default_rng(0)
    actions = random_actions(num_envs)
    actions[..., :2] = 1.0
    turns = rng.random((50, num_envs)) < 0.1
    actions[turns, :2] = rng.uniform(-1, 1, (int(turns.sum()), 2))
    actions[..., 2] = -1
    return actions


def measure_single_env() -> Iterator[Row]:
    """Step one environment made by `gymnasium.make`, with its wrappers."""
    env = gymnasium.make("CyclicLoop-v0", map_name="killian_court")
    env.reset(seed=0)
    actions = random_actions(1)[:, 0]

    def run() -> None:
        for i in range(1000):
            env.step(actions[i % 50])

    yield Row("one env", "gymnasium.make", 1000 / best_time(run), "steps/s", least=10_000)


def measure_vector_env(quick: bool) -> Iterator[Row]:
    """Step the vector environment at several sizes; everything that a step does is included."""
    base = 0.0
    for num_envs in (1, 64, 256) if quick else (1, 64, 256, 1024):
        env = gymnasium.make_vec("CyclicLoop-v0", num_envs=num_envs, map_name="killian_court")
        steps = max(20, 50_000 // num_envs // (4 if quick else 1))
        rate = rate_of(env, random_actions(num_envs), min(steps, 3000))
        base = base or rate
        least = 150_000 if num_envs == 256 else -math.inf
        yield Row("vector env", f"N = {num_envs}, random actions", rate, "robot-steps/s", least=least)
        if num_envs > 1:
            yield Row("vector env", f"N = {num_envs}, all cores, against N = 1", rate / base, "x")
        env.close()
    env = gymnasium.make_vec("CyclicLoop-v0", num_envs=256, map_name="killian_court")
    yield Row("vector env", "N = 256, driving", rate_of(env, driving_actions(256), 200), "robot-steps/s")
    for noise in ("calibrated", "typical"):
        env = gymnasium.make_vec("CyclicLoop-v0", num_envs=256, map_name="killian_court", noise=noise)
        rate = rate_of(env, random_actions(256), 100)
        yield Row("vector env", f"N = 256, random actions, {noise}", rate, "robot-steps/s")


def sixteen_plans() -> list[FloorPlan]:
    """Return the shipped plans, and mirror images of some to make 16."""
    plans = [load_floor_plan(name) for name in map_names()]
    for plan in plans[: 16 - len(plans)]:
        mirrored = scale(plan.free_space, xfact=-1, origin=(0, 0))
        x, y, heading = plan.start
        plans.append(FloorPlan(f"{plan.name}_mirrored", mirrored, (-x, y, math.pi - heading)))
    return plans


def measure_pool() -> Iterator[Row]:
    """Step 256 robots in a pool of 16 plans."""
    env = CyclicLoopVectorEnv(256, sixteen_plans())
    rate = rate_of(env, random_actions(256), 100)
    yield Row("pool", "16 plans, N = 256", rate, "robot-steps/s", least=50_000)


def measure_phases() -> Iterator[Row]:
    """Time the stages of a step at N = 256 on one core; what remains is the Python code between them."""
    env = CyclicLoopVectorEnv(256, "killian_court", num_threads=1)
    actions = driving_actions(256)
    rate_of(env, actions, 50)
    runs = []
    for _ in range(REPEATS):
        timer = env.time_stages()
        begin = time.perf_counter()
        for action in actions:
            env.step(action)
        runs.append((time.perf_counter() - begin, timer.seconds))
    total, seconds = min(runs, key=lambda run: run[0])
    phases = {name: seconds[stage] for stage, name in STAGES.items()}
    plan, laser, info = env.floor_plan(0), env.config.laser, env.info_records
    poses = np.column_stack([info["x"], info["y"], info["heading"]])
    tiles, beams = build_wall_index(plan, laser.range_max), laser_beams(laser)
    scratch, ranges = np.empty(2 * laser.num_beams), np.empty((256, laser.num_beams))
    scans = best_time(lambda: scan_all(tiles, poses, beams, scratch, ranges), 50)
    phases["laser"] = scans * len(actions)
    phases[STAGES["judge"]] -= phases["laser"]  # which is part of it
    phases["rest"] = total - sum(phases.values())
    for phase, value in [*phases.items(), ("together", total)]:
        yield Row("a step", f"one core, N = 256: {phase}", value / len(actions) / 256 * 1e6, "us a robot")


def measure_memory(steps: int) -> Iterator[Row]:
    """Step 1,024 robots in a process of its own, and on Linux measure its greatest use of memory."""
    if sys.platform == "linux":  # getrusage would tell the most that this process took, if that is more
        peak = run_python(
            "import re, numpy, gymnasium, cyclic_env\n"
            "env = gymnasium.make_vec('CyclicLoop-v0', num_envs=1024, map_name='killian_court'); env.reset(seed=0)\n"
            f"for i in range({steps}): env.step(numpy.tile(numpy.float32([1, .9, -1, 0]), (1024, 1)))\n"
            "print(re.search(r'VmHWM:\\s+(\\d+)', open('/proc/self/status').read())[1])"
        )
        yield Row("memory", f"1,024 rows after {steps} steps", peak / 1e6, "GB", most=2)
    env = CyclicLoopVectorEnv(1024, "killian_court")
    memory = allocate_memory(env.floor_plan(0), env.num_envs, env.step_budget(0), env.config.closure)
    room = sum(array.nbytes for array in memory if isinstance(array, np.ndarray))
    yield Row("memory", "1,024 rows, their paths at the end of the longest episodes, at most", room / 1e9, "GB")


def measure_start_up() -> Iterator[Row]:
    """Time the import of the package, and the compilation of its kernels without a cache, each in its own process."""
    begin = time.perf_counter()
    run_python("import cyclic_env; print(0)")
    yield Row("start-up", "python -c 'import cyclic_env'", time.perf_counter() - begin, "s", most=1)
    code = (
        "import time, numpy, cyclic_env; from cyclic_env import CyclicLoopEnv; env = CyclicLoopEnv('ring')\n"
        "begin = time.perf_counter(); env.reset(seed=0); env.step(numpy.zeros(4)); print(time.perf_counter() - begin)"
    )
    with tempfile.TemporaryDirectory(prefix="cyclic_env_benchmark_") as cache:
        yield Row("start-up", "first compile", run_python(code, NUMBA_CACHE_DIR=cache), "s", most=30)
        yield Row("start-up", "compiled code from the cache", run_python(code, NUMBA_CACHE_DIR=cache), "s")


def measure_walls(steps: int) -> Iterator[Row]:
    """Drive `steps` random steps on every plan, and measure how near the robots' centres come to a wall."""
    robot = RobotConfig()
    for name in map_names():
        plan = load_floor_plan(name)
        boundary = plan.free_space.boundary
        for geometry in (boundary, plan.free_space):
            shapely.prepare(geometry)
        simulation, rng = Simulation(robot, [plan], 256), np.random.default_rng(0)
        for row, pose in enumerate(free_poses(plan, 256)):
            simulation.place(row, 0, pose.tolist())
        clearance, contacts, commands = math.inf, 0, np.zeros((256, 2))
        touching = np.zeros(256, bool)
        for step in range(-(-steps // 256)):
            if step % 15 == 0:
                commands = robot.wheel_speed_max * rng.choice([-1.0, 0.5, 1.0, 1.0, 1.0], (256, 2))
            for world in simulation.worlds:
                simulation.drive_world(world, commands)
            contacts += int((simulation.drive["contact"] & ~touching).sum())
            touching = simulation.drive["contact"].copy()
            x, y = simulation.drive["x"], simulation.drive["y"]
            if not shapely.contains_xy(plan.free_space, x, y).all():
                raise SystemExit(f"{name}: a robot left free space")
            clearance = min(clearance, float(shapely.distance(shapely.points(x, y), boundary).min()))
        yield Row("walls", f"{name}: least clearance, {contacts} contacts", clearance, "m", least=0.19)
