"""Measurements of training: through Stable-Baselines3, and of the task headings."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from typing import Any

from agents.rl import require_learning
from cyclic_env import ConfigError, CyclicLoopVectorEnv
from scripts.speed.rows import Row, best_time, random_actions, rate_of


def measure_stable_baselines() -> Iterator[Row]:
    """Collect steps with the `VecEnv` of Stable-Baselines3, without and with a policy."""
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
    """Train the task headings with 256 robots on generated buildings; measure the speed, and where the time goes."""
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
    """Return the function, wrapped so that each call adds its time to a stage."""

    def run(*arguments: Any, **settings: Any) -> Any:
        begin = time.perf_counter()
        try:
            return function(*arguments, **settings)
        finally:
            seconds[stage] += time.perf_counter() - begin

    return run
