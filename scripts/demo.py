"""Drive a building once, by default Killian Court by the wall on the left; write a picture, print the scores."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # agents are not installed, but run from the checkout
if __name__ == "__main__":  # Ctrl-C while the packages load
    signal.signal(signal.SIGINT, lambda *_: (print("\ndemo.py: nothing done yet", file=sys.stderr), os._exit(130)))

import argparse
from collections.abc import Sequence

import matplotlib.pyplot as plt

from agents import agent_names, make_agent
from agents.scripted import ScriptedAgent
from cyclic_env import CyclicLoopEnv, CyclicLoopError, map_names
from cyclic_env.evaluation import ProgressLine

SCORES = ("cycles_closed", "cycles_total", "false_claims", "revisits_recognised", "revisits", "coverage", "collisions")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code: 0, 2 for bad input, 130 after Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--agent", default="circling", help=f"{', '.join(agent_names())} (default circling)")
    parser.add_argument("--map", default="killian_court", help=f"{', '.join(map_names())}, or a file")
    parser.add_argument("--steps", type=int, help="how many (default: to the episode's end)")
    parser.add_argument("--out", type=Path, default=Path("out/demo"), help="folder for the picture (default out/demo)")
    args = parser.parse_args(arguments)
    if args.steps is not None and args.steps < 1:
        parser.error(f"--steps is {args.steps}; expected at least 1")
    try:
        agent = make_agent(args.agent)
        env = CyclicLoopEnv(args.map, render_mode="rgb_array")
        args.out.mkdir(parents=True, exist_ok=True)
        total = drive(env, agent, args.steps or env.step_budget)
        picture = args.out / "run.png"
        plt.imsave(picture, env.render())
    except (CyclicLoopError, OSError) as error:
        print(f"demo.py: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("\ndemo.py: stopped before the end, so nothing is written; --steps makes a shorter run.", file=sys.stderr)
        return 130
    print(f"{args.agent} on {args.map}: return {total:.1f}; picture in {picture}")
    return 0


def drive(env: CyclicLoopEnv, agent: ScriptedAgent, steps: int) -> float:
    """Run an episode of at most `steps` steps, print its scores, and return its return."""
    observation, info = env.reset(seed=0)
    state, total, progress = None, 0.0, ProgressLine()
    for step in range(steps):
        action, state = agent.predict(observation, state)
        observation, reward, terminated, truncated, info = env.step(action)
        total += reward
        progress.show(f"step {step + 1} of {steps}")
        if terminated or truncated:
            break
    progress.clear()
    for name in SCORES:
        print(f"{name:>20} {info[name] if isinstance(info[name], int) else round(info[name], 3)}")
    return total


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.exit(main())
