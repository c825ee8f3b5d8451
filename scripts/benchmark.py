"""Measure the speed of the environment: one table, all ratios from one run.

    python scripts/benchmark.py [--json FILE] [--quick] [--walls]

Every rate is the best of five, since other work on a machine only ever slows it down.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pymunk
import shapely
from shapely.affinity import scale

import cyclic_env
from cyclic_env import CyclicLoopVectorEnv, FloorPlan, load_floor_plan, map_names
from cyclic_env.compiled import compiled
from cyclic_env.config import LaserConfig, RobotConfig
from cyclic_env.engine import Engine, engine_config, step_rows
from cyclic_env.floor_plans.wall_tiles import build_wall_tiles
from cyclic_env.laser import beam_directions, scan, scan_row
from cyclic_env.simulation import Simulation

REPEATS = 5
Row = tuple[str, str, float, str]


@compiled
def scan_all(tiles, poses, directions, range_max, scratch, ranges):
    """Scan from every pose, without the cost of a call from Python for each."""
    for i in range(poses.shape[0]):
        scan_row(tiles, 0, poses[i, 0], poses[i, 1], poses[i, 2], directions, range_max, scratch, ranges[i])


def best_time(function: Callable[[], Any], repeats: int = REPEATS) -> float:
    """Return the shortest of several run times of `function`, seconds, after one run to warm up."""
    function()
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        function()
        times.append(time.perf_counter() - begin)
    return min(times)


def free_poses(plan: FloorPlan, count: int) -> np.ndarray:
    """Return random poses `(count, 3)` where the robot can stand."""
    rng, area = np.random.default_rng(0), plan.reachable(RobotConfig().radius)
    poses = np.empty((0, 3))
    while len(poses) < count:
        draw = rng.uniform((*plan.bounds[:2], -math.pi), (*plan.bounds[2:], math.pi), (20 * count, 3))
        poses = np.concatenate([poses, draw[shapely.contains_xy(area, draw[:, 0], draw[:, 1])]])
    return poses[:count]


def measure_machine() -> Iterator[Row]:
    """Time plain Python, by which rates of different machines, or of a busy hour, can be compared."""
    yield "machine", "10^7 additions in a Python loop", best_time(lambda: sum(i for i in range(10**7))), "s"


def measure_laser() -> Iterator[Row]:
    """Time one scan of 180 beams on Killian Court, three ways."""
    plan, laser = load_floor_plan("killian_court"), LaserConfig()
    poses = free_poses(plan, 2000)
    tiles, directions = build_wall_tiles([plan], laser.range_max), beam_directions(laser)
    scratch, ranges = np.empty(2 * laser.num_beams), np.empty((len(poses), laser.num_beams))
    compiled_scan = best_time(lambda: scan_all(tiles, poses, directions, laser.range_max, scratch, ranges)) / len(poses)
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
    yield "laser", "z-buffer, one scan", compiled_scan * 1e6, "us"
    yield "laser", "NumPy twin / z-buffer", twin / compiled_scan, "x"
    yield "laser", "180 pymunk queries / z-buffer (at least 60)", queries / compiled_scan, "x"
    yield "laser", "largest difference from the twin", worst, "m"


ALL_SHAPES = pymunk.ShapeFilter()


def rate_of(env: Any, actions: np.ndarray, steps: int) -> float:
    """Return robot-steps a second of a vector env, best of several."""
    env.reset(seed=0)

    def run() -> None:
        for i in range(steps):
            env.step(actions[i % len(actions)])

    return steps * env.num_envs / best_time(run)


def random_actions(num_envs: int) -> np.ndarray:
    """Return uniformly random actions `(50, num_envs, 4)`, half of them claims."""
    return np.random.default_rng(0).uniform(-1, 1, (50, num_envs, 4)).astype(np.float32)


def driving_actions(num_envs: int) -> np.ndarray:
    """Return actions that drive at full speed, turn now and then, and meet walls, so that the robots spread."""
    rng = np.random.default_rng(0)
    actions = random_actions(num_envs)
    actions[..., :2] = 1.0
    turns = rng.random((50, num_envs)) < 0.1
    actions[turns, :2] = rng.uniform(-1, 1, (int(turns.sum()), 2))
    actions[..., 2] = -1
    return actions


def measure_single_env() -> Iterator[Row]:
    """Step one environment through `gymnasium.make`, wrappers and all."""
    env = gymnasium.make("CyclicLoop-v0", map_name="killian_court")
    env.reset(seed=0)
    actions = random_actions(1)[:, 0]

    def run() -> None:
        for i in range(1000):
            env.step(actions[i % 50])

    yield "one env", "gymnasium.make (at least 10,000)", 1000 / best_time(run), "steps/s"


def measure_vector_env(quick: bool) -> Iterator[Row]:
    """Step the vector environment at several sizes, everything in."""
    base = 0.0
    for num_envs in (1, 64, 256) if quick else (1, 64, 256, 1024):
        env = gymnasium.make_vec("CyclicLoop-v0", num_envs=num_envs, map_name="killian_court")
        steps = max(20, 50_000 // num_envs // (4 if quick else 1))
        rate = rate_of(env, random_actions(num_envs), min(steps, 3000))
        base = base or rate
        aim = " (at least 150,000)" if num_envs == 256 else ""
        yield "vector env", f"N = {num_envs}, random actions{aim}", rate, "robot-steps/s"
        if num_envs > 1:
            yield "vector env", f"N = {num_envs}, all cores, against N = 1", rate / base, "x"
        env.close()
    env = gymnasium.make_vec("CyclicLoop-v0", num_envs=256, map_name="killian_court")
    yield "vector env", "N = 256, driving", rate_of(env, driving_actions(256), 200), "robot-steps/s"
    for noise in ("calibrated", "typical"):
        env = gymnasium.make_vec("CyclicLoop-v0", num_envs=256, map_name="killian_court", noise=noise)
        yield "vector env", f"N = 256, random actions, {noise}", rate_of(env, random_actions(256), 100), "robot-steps/s"


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
    yield "pool", "16 plans, N = 256 (at least 50,000)", rate_of(env, random_actions(256), 100), "robot-steps/s"


def measure_phases() -> Iterator[Row]:
    """Time the phases of a step at N = 256, on one core, as shares of their sum."""
    engine, rows = Engine(engine_config(map_name="killian_court"), 256), np.arange(256)
    rngs = [np.random.default_rng(i) for i in rows]
    for row in rows:
        engine.reset_row(int(row), rngs[row])
    for actions in random_actions(256):
        engine.step(actions, rngs)
    actions, simulation, episodes = random_actions(256)[0], engine.simulation, engine.episodes
    poses = np.column_stack([engine.info["x"], engine.info["y"], engine.info["heading"]])
    directions, scratch = engine.buildings.directions, np.empty(360)
    commands, claims = np.full((256, 2), 0.5), np.full(256, -2)
    times = {
        "actions": best_time(lambda: engine._take_actions(actions), 50),
        "drive (pymunk)": best_time(lambda: [simulation.drive_world(w, commands) for w in simulation.worlds], 50),
        "laser": best_time(
            lambda: scan_all(engine.buildings.tiles, poses, directions, 12.0, scratch, episodes.true_ranges), 50
        ),
        "mark, judge, reward, info": best_time(lambda: step_rows(engine.buildings, episodes, rows, claims), 50),
        "sensors": best_time(lambda: engine.measure(rows, rngs), 50),
        "observation": best_time(engine.observation, 50),
    }
    times["mark, judge, reward, info"] -= times["laser"]
    total = sum(times.values())
    for phase, seconds in times.items():
        yield "phases", f"{phase}: {seconds / 256 * 1e6:.2f} us a robot", 100 * seconds / total, "%"


def measure_stable_baselines() -> Iterator[Row]:
    """Collect steps through the Stable-Baselines3 VecEnv, without and with a policy."""
    try:
        import torch
        from stable_baselines3 import PPO

        from agents.sb3 import CyclicLoopVecEnv
    except ImportError:
        return
    torch.set_num_threads(1)
    native = CyclicLoopVectorEnv(64, "killian_court", autoreset_mode="SAME_STEP")
    base = rate_of(native, random_actions(64), 200)
    env = CyclicLoopVecEnv(64, map_name="killian_court")
    env.seed(0)
    env.reset()
    actions = random_actions(64)
    seconds = best_time(lambda: [env.step(actions[i % 50]) for i in range(200)]) / 200
    yield "SB3", "VecEnv, N = 64", 64 / seconds, "robot-steps/s"
    yield "SB3", "VecEnv / native vector env", 64 / seconds / base, "x"
    model = PPO("MultiInputPolicy", env, n_steps=32, batch_size=512, n_epochs=1, device="cpu")
    begin = time.perf_counter()
    model.learn(64 * 32 * 4)
    yield "SB3", "PPO, collecting and learning, N = 64", 64 * 32 * 4 / (time.perf_counter() - begin), "robot-steps/s"


def measure_memory() -> Iterator[Row]:
    """Step 1,024 robots in a process of its own and see what it took at most."""
    code = (
        "import resource, numpy, gymnasium, cyclic_env\n"
        "env = gymnasium.make_vec('CyclicLoop-v0', num_envs=1024, map_name='killian_court'); env.reset(seed=0)\n"
        "for i in range(200): env.step(numpy.tile(numpy.float32([1, .9, -1, 0]), (1024, 1)))\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    yield "memory", "1,024 rows after 200 steps", int(result.stdout.split()[-1]) / 1e6, "GB"
    memory = CyclicLoopVectorEnv(1024, "killian_court").engine.episodes.memory
    room = sum(array.nbytes for array in memory[:7])
    yield "memory", "1,024 rows, their paths at the end of the longest episodes, at most", room / 1e9, "GB"


def measure_start_up() -> Iterator[Row]:
    """Import the package, and compile its kernels without a cache, each in a process of its own."""
    begin = time.perf_counter()
    subprocess.run([sys.executable, "-c", "import cyclic_env"], check=True, cwd=ROOT)
    yield "start-up", "python -c 'import cyclic_env' (at most 1)", time.perf_counter() - begin, "s"
    code = (
        "import time, numpy, cyclic_env; from cyclic_env.env import CyclicLoopEnv; env = CyclicLoopEnv('ring')\n"
        "begin = time.perf_counter(); env.reset(seed=0); env.step(numpy.zeros(4)); print(time.perf_counter() - begin)"
    )
    cache = Path(os.environ.get("TMPDIR", "/tmp")) / f"cyclic_env_benchmark_{os.getpid()}"
    for what in ("first compile (at most 30)", "compiled code from the cache"):
        environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache)}
        result = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT, env=environment
        )
        yield "start-up", what, float(result.stdout.split()[-1]), "s"


def measure_walls(steps: int) -> Iterator[Row]:
    """Drive `steps` random steps on every plan and see how near a centre comes to a wall."""
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
        yield "walls", f"{name}: least clearance, {contacts} contacts (at least 0.19)", clearance, "m"


ROOT = Path(__file__).resolve().parents[1]


def main() -> None:
    """Run the measurements and print them as they come."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the results there as well")
    parser.add_argument("--quick", action="store_true", help="fewer steps, up to 256 rows")
    parser.add_argument("--walls", action="store_true", help="only drive 10^6 steps into walls on every plan")
    arguments = parser.parse_args()
    if arguments.json and not arguments.json.resolve().parent.is_dir():
        parser.error(f"--json: there is no folder {arguments.json.resolve().parent}")
    sys.path.insert(0, str(ROOT))
    measurements: list[Callable[[], Iterator[Row]]] = [
        measure_machine,
        measure_laser,
        measure_single_env,
        lambda: measure_vector_env(arguments.quick),
        measure_pool,
        measure_phases,
        measure_stable_baselines,
        measure_memory,
        measure_start_up,
    ]
    if arguments.walls:
        measurements = [lambda: measure_walls(1_000_000)]
    versions = f"cyclic_env {cyclic_env.__version__}, Python {platform.python_version()}, pymunk {pymunk.version}"
    print(f"{versions}, {os.cpu_count()} cores\n\n| what | measurement | value | unit |\n|---|---|---:|---|")
    rows = []
    for measurement in measurements:
        for what, name, value, unit in measurement():
            shown = f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
            print(f"| {what} | {name} | {shown} | {unit} |", flush=True)
            rows.append({"what": what, "measurement": name, "value": value, "unit": unit})
    if arguments.json:
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        text = json.dumps({"versions": versions, "peak_rss_kb": peak, "results": rows}, indent=1)
        arguments.json.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
