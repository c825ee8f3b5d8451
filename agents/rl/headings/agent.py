"""A trained model of the task headings as a policy for `CyclicLoopEnv`, on the same footing as all other agents."""

from __future__ import annotations

import inspect
from typing import Any

import numpy as np

from agents.actions import Decision, encode_action
from agents.rl.headings.env import FEATURES
from agents.rl.headings.memory import HOLD, Rules
from agents.rl.headings.perception import Perception
from cyclic_env.config import ActionType


def takes_masks(model: Any) -> bool:
    """Tell whether a model asks which actions there are, as those of `MaskablePPO` do."""
    return "action_masks" in inspect.signature(model.predict).parameters


class HeadingsState:
    """What the agent remembers of N robots: their perception, the decisions that they hold, and for how long yet."""

    def __init__(self, robots: int, rules: Rules) -> None:
        self.perception = Perception(robots, rules)
        self.commands = np.zeros((robots, 4), np.float32)
        self.held = np.zeros(robots, np.int64)


class HeadingsAgent:
    """Takes a decision for every five steps by a model, and drives and claims by it.

    Parameters
    ----------
    model : MaskablePPO or PPO
        Trained on `CyclicLoopHeadings-v0`.
    rules : Rules, optional
        Those of the environment.
    action_type : {"twist", "wheels", "discrete"}
        That of the environment. By twist the agent drives as it does in the environment that it was trained on.
    """

    def __init__(self, model: Any, rules: Rules | None = None, *, action_type: ActionType = "twist") -> None:
        self.model = model
        self.rules = rules or Rules()
        self.action_type: ActionType = action_type
        self._takes_masks = takes_masks(model)

    def predict(
        self,
        observation: dict[str, np.ndarray],
        state: HeadingsState | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, HeadingsState]:
        """Return actions, and what to remember; see `KnnExplorer.predict`."""
        single = observation["laser"].ndim == 1
        if single:
            observation = {name: value[None] for name, value in observation.items()}
        count = len(observation["laser"])
        if state is None:
            state, episode_start = HeadingsState(count, self.rules), np.ones(count, np.bool_)
        begun = np.zeros(count, np.bool_) if episode_start is None else np.asarray(episode_start, np.bool_).ravel()
        perception, every = state.perception, np.arange(count)
        perception.begin(np.flatnonzero(begun))
        perception.sense(observation, every)
        state.held[begun] = 0
        due = np.flatnonzero(state.held == 0)
        state.commands[:, 2] = -1.0
        if len(due):
            self._decide(state, due, deterministic)
            state.held[due] = HOLD
        state.held -= 1
        perception.steer(every, state.commands)
        rows = [
            encode_action(Decision(speed, turn, claim > 0, match), self.action_type)
            for speed, turn, claim, match in state.commands.tolist()
        ]
        actions = np.array(rows, np.int64 if self.action_type == "discrete" else np.float32)
        return (actions[0] if single else actions), state

    def _decide(self, state: HeadingsState, rows: np.ndarray, deterministic: bool) -> None:
        perception = state.perception
        perception.observe(rows)
        features = {name: getattr(perception.memory, name)[rows] for name in FEATURES}
        masks = {"action_masks": perception.action_masks()[rows]} if self._takes_masks else {}
        choices, _ = self.model.predict(features, deterministic=deterministic, **masks)
        perception.decide(choices[:, 0], rows)
        claiming, steps = perception.claim(choices[:, 1], rows)
        state.commands[claiming, 2] = 1.0
        state.commands[claiming, 3] = 2 * steps / (perception.memory.robots["steps"][claiming] + 1) - 1
