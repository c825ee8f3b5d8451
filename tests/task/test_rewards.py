"""What the reward's terms charge and pay, beyond what the drives of `test_drives` show."""

from __future__ import annotations

import numpy as np
import pytest

from cyclic_env.envs.cyclic_loop import CyclicLoopEnv


@pytest.mark.parametrize("wheels", [1.0, 0.0], ids=["full ahead into the wall", "standing still"])
def test_crashing_takes_no_less_time_than_using_up_the_budget(wheels: float):
    env = CyclicLoopEnv("ring", terminate_on_collision=True, step_budget=400)
    env.reset(seed=0)
    steps, time, done, contact = 0, 0.0, False, False
    while not done:
        _, _, contact, truncated, info = env.step(np.array([wheels, wheels, -1, 0], np.float32))
        time += info["reward_terms"]["time"]
        steps += 1
        done = contact or truncated
    assert contact == (wheels > 0) == (steps < 400)
    assert time == pytest.approx(-10)
    env.close()
