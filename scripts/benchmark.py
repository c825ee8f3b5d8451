"""Measure the speed of the environment: one table, all ratios from one run, with a verdict where there is a target.

    python scripts/benchmark.py [--json FILE] [--quick] [--walls]

Every rate is the best of five, since other work on a machine only ever slows it down.
"""

from __future__ import annotations

if __name__ == "__main__":
    from _cli import run_script

    run_script(__file__)

import json
import math
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import pymunk
import shapely
from numba import njit
from shapely.affinity import scale

import cyclic_env
from agents.rl import require_learning
from cyclic_env import ConfigError, CyclicLoopVectorEnv, FloorPlan, load_floor_plan, map_names
from cyclic_env.atomic_write import check_writable, write_text_atomically
from cyclic_env.config import LaserConfig, RobotConfig
from cyclic_env.simulation.lidar import laser_beams, scan, scan_row
from cyclic_env.simulation.physics import Simulation
from cyclic_env.simulation.wall_index import build_wall_index
from cyclic_env.task.path_history import allocate_memory
from scripts._arguments import Flag, OptionalFile
from scripts._cli import command, interruptible

ROOT = Path(__file__).resolve().parents[1]
REPEATS = 5


class Row(NamedTuple):
    """One measurement, and what it should be: at least or at most so much."""

    what: str
    name: str
    value: float
    unit: str
    least: float = -math.inf
    most: float = math.inf

    @property
    def formatted(self) -> str:
        """The value for the table."""
        if math.isnan(self.value):
            return "-"
        return f"{self.value:,.0f}" if abs(self.value) >= 1000 else f"{self.value:.3g}"

    @property
    def target(self) -> str:
        """What the value should be, or nothing."""
        if self.least > -math.inf:
            return f"at least {self.least:,g}"
        return f"at most {self.most:,g}" if self.most < math.inf else ""

    @property
    def verdict(self) -> str:
        """Whether it is."""
        if not self.target:
            return ""
        return "ok" if self.least <= self.value <= self.most else "MISSED"

    def to_json(self) -> dict[str, Any]:
        """Return the row as plain values, with None for NaN."""
        return {
            "what": self.what,
            "measurement": self.name,
            "value": None if math.isnan(self.value) else self.value,
            "unit": self.unit,
            "target": self.target,
            "verdict": self.verdict,
        }


@njit(error_model="numpy")  # not cached: numba can't find a script's functions when it runs under another name
def scan_all(tiles, poses, beams, scratch, ranges):
    """Scan from every pose, without the cost of a call from Python for each."""
    for i in range(poses.shape[0]):
        scan_row(tiles, 0, (poses[i, 0], poses[i, 1], poses[i, 2]), beams, scratch, ranges[i])


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

    yield Row("one env", "gymnasium.make", 1000 / best_time(run), "steps/s", least=10_000)


def measure_vector_env(quick: bool) -> Iterator[Row]:
    """Step the vector environment at several sizes, everything in."""
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


STAGES = {
    "actions": "actions",
    "drive": "drive (pymunk)",
    "judge": "mark, judge, reward, info",
    "sensors": "sensors",
    "observation": "observation",
}
"""The stages of a step that the environment times, and what the table calls them."""


def measure_phases() -> Iterator[Row]:
    """Time the stages of a step at N = 256 on one core; the rest of it is the Python between them."""
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


def measure_stable_baselines() -> Iterator[Row]:
    """Collect steps through the Stable-Baselines3 VecEnv, without and with a policy."""
    try:
        require_learning()
    except ConfigError as error:
        yield Row("SB3", f"not measured: {error}", math.nan, "")
        return
    import torch
    from stable_baselines3 import PPO

    from agents.rl.vec_env import CyclicLoopVecEnv

    torch.set_num_threads(1)
    native = CyclicLoopVectorEnv(64, "killian_court", autoreset_mode="SAME_STEP")
    base = rate_of(native, random_actions(64), 200)
    env = CyclicLoopVecEnv(64, map_name="killian_court")
    env.seed(0)
    env.reset()
    actions = random_actions(64)
    seconds = best_time(lambda: [env.step(actions[i % 50]) for i in range(200)]) / 200
    yield Row("SB3", "VecEnv, N = 64", 64 / seconds, "robot-steps/s")
    yield Row("SB3", "VecEnv / native vector env", 64 / seconds / base, "x")
    model = PPO("MultiInputPolicy", env, n_steps=32, batch_size=512, n_epochs=1, device="cpu")
    begin = time.perf_counter()
    model.learn(64 * 32 * 4)
    rate = 64 * 32 * 4 / (time.perf_counter() - begin)
    yield Row("SB3", "PPO, collecting and learning, N = 64", rate, "robot-steps/s")


def measure_headings(quick: bool) -> Iterator[Row]:
    """Train the task headings with 256 robots on generated buildings, everything in; and where the time goes."""
    try:
        require_learning()
    except ConfigError as error:
        yield Row("headings", f"not measured: {error}", math.nan, "")
        return
    import torch

    from agents.rl.headings.vec_env import HeadingsVecEnv
    from agents.rl.models import hyperparameter_file, new_model, read_hyperparameters

    torch.set_num_threads(1)
    hyperparameters = read_hyperparameters(hyperparameter_file("headings", "maskable_ppo"), "maskable_ppo")
    env = HeadingsVecEnv(256, map_name=[f"generated:cycles=4,seed={seed}" for seed in range(16)], noise="calibrated")
    model = new_model("maskable_ppo", hyperparameters, env, 0, discrete=True)
    update = model.n_steps * env.num_envs  # pyright: ignore[reportAttributeAccessIssue]
    model.learn(update)  # the maps fill, and the kernels are compiled
    seconds = {"update": 0.0, "step": 0.0}
    for owner, name, stage in ((model, "train", "update"), (env, "step_wait", "step")):
        setattr(owner, name, timed(getattr(owner, name), seconds, stage))
    before, begin, updates = dict(env.env.seconds), time.perf_counter(), 1 if quick else 3
    model.learn(updates * update)
    total = time.perf_counter() - begin
    stages = {stage: env.env.seconds[stage] - before[stage] for stage in before}
    yield Row("headings", "MaskablePPO, N = 256", updates * update / total, "decisions/s", least=1500)
    stages["network"] = total - seconds["update"] - seconds["step"]
    stages["update"] = seconds["update"]
    for stage, spent in stages.items():
        yield Row("headings", f"share of {stage}", 100 * spent / total, "%")
    env.close()


def timed(function: Callable[..., Any], seconds: dict[str, float], stage: str) -> Callable[..., Any]:
    """Return the function, which from now on adds the time that it takes to a stage."""

    def run(*arguments: Any, **settings: Any) -> Any:
        begin = time.perf_counter()
        try:
            return function(*arguments, **settings)
        finally:
            seconds[stage] += time.perf_counter() - begin

    return run


def run_python(code: str, **environment: str) -> float:
    """Run a program in a process of its own, and return the number that it prints last."""
    result = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        cwd=ROOT,
        env={**os.environ, **environment},
    )
    return float(result.stdout.split()[-1])


def measure_memory(steps: int) -> Iterator[Row]:
    """Step 1,024 robots in a process of its own and see what it took at most."""
    peak = run_python(
        "import resource, numpy, gymnasium, cyclic_env\n"
        "env = gymnasium.make_vec('CyclicLoop-v0', num_envs=1024, map_name='killian_court'); env.reset(seed=0)\n"
        f"for i in range({steps}): env.step(numpy.tile(numpy.float32([1, .9, -1, 0]), (1024, 1)))\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)"
    )
    yield Row("memory", f"1,024 rows after {steps} steps", peak / 1e6, "GB", most=2)
    env = CyclicLoopVectorEnv(1024, "killian_court")
    memory = allocate_memory(env.floor_plan(0), env.num_envs, env.step_budget(0), env.config.closure)
    room = sum(array.nbytes for array in memory if isinstance(array, np.ndarray))
    yield Row("memory", "1,024 rows, their paths at the end of the longest episodes, at most", room / 1e9, "GB")


def measure_start_up() -> Iterator[Row]:
    """Import the package, and compile its kernels without a cache, each in a process of its own."""
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
        yield Row("walls", f"{name}: least clearance, {contacts} contacts", clearance, "m", least=0.19)


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of the command."""

    json: OptionalFile = None
    """write the results there as well"""
    quick: Flag = False
    """fewer steps"""
    walls: Flag = False
    """only drive 10^6 steps into walls on every plan"""


@command(Options)
def main(args: Options) -> None:
    """Run the measurements and print them as they come."""
    if args.json:
        check_writable(args.json)
    measurements: list[Callable[[], Iterator[Row]]] = [
        measure_machine,
        measure_laser,
        measure_single_env,
        lambda: measure_vector_env(args.quick),
        measure_pool,
        measure_phases,
        measure_stable_baselines,
        lambda: measure_headings(args.quick),
        lambda: measure_memory(20 if args.quick else 200),
        measure_start_up,
    ]
    if args.walls:
        measurements = [lambda: measure_walls(1_000_000)]
    versions = f"cyclic_env {cyclic_env.__version__}, Python {platform.python_version()}, pymunk {pymunk.version}"
    print(f"{versions}, {os.cpu_count()} cores\n")
    print("| what | measurement | value | unit | target | |\n|---|---|---:|---|---|---|")
    rows: list[Row] = []
    with interruptible() as interruption:
        for measurement in measurements:
            for row in measurement():
                rows.append(row)
                print(f"| {row.what} | {row.name} | {row.formatted} | {row.unit} | {row.target} | {row.verdict} |")
    if args.json:
        results = {"versions": versions, "complete": not interruption, "results": [row.to_json() for row in rows]}
        write_text_atomically(args.json, json.dumps(results, indent=1) + "\n")
    if interruption:
        kept = f" and in {args.json}" if args.json else ""
        raise interruption.stopped(f"the {len(rows)} rows measured so far are above{kept}.")
