"""A trained model of the task headings as a policy for `CyclicLoopEnv`, on the same footing as all other agents."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from typing import Any

import numpy as np

from agents.actions import Decision, encode_action
from agents.base import read_observation
from agents.rl.headings.env import FEATURES
from agents.rl.headings.memory import HEADINGS, HOLD, Rules
from agents.rl.headings.perception import Perception
from cyclic_env.config import ActionType
from cyclic_env.errors import ConfigError


def takes_masks(model: Any) -> bool:
    """Tell whether a model asks which actions there are, as those of `MaskablePPO` do."""
    return model is not None and "action_masks" in inspect.signature(model.predict).parameters


class HeadingsState:
    """What the agent remembers of N robots: their perception, the decisions that they hold, and for how long yet.

    What `RandomHeadingsAgent` draws depends on `seeds` and on the number of the decision.
    """

    def __init__(self, robots: int, rules: Rules) -> None:
        self.perception = Perception(robots, rules)
        self.commands = np.zeros((robots, 4), np.float32)
        self.held = np.zeros(robots, np.int64)
        self.seeds = np.arange(robots)


class HeadingsAgent:
    """Takes a decision for every five steps by a model, and drives and claims by it.

    Parameters
    ----------
    model : MaskablePPO, PPO or any object with their ``predict``
        Trained on `CyclicLoopHeadings-v0`; or a rule, see `agents.rl.headings.rules`.
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
        """Return actions, and what to remember; see `agents.base.BatchPolicy.predict`."""
        laser, distance, compass, single = read_observation(observation)
        count = len(laser)
        if state is None:
            state, episode_start = HeadingsState(count, self.rules), np.ones(count, np.bool_)
        begun = np.zeros(count, np.bool_) if episode_start is None else np.asarray(episode_start, np.bool_).ravel()
        if not isinstance(state, HeadingsState) or not len(state.held) == len(begun) == count:
            raise ConfigError(
                f"the state or episode_start is not that of the observation's {count} robots; expected what the last "
                "predict returned, or None to begin."
            )
        perception, every = state.perception, np.arange(count)
        perception.begin(np.flatnonzero(begun))
        perception.sense({"laser": laser, "distance": distance[:, None], "compass": compass}, every)
        state.held[begun] = 0
        state.seeds[begun] += 2**32  # so that the next episode of a row is another one
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
        choices = self._choose(state, rows, deterministic)
        perception.decide(choices[:, 0], rows)
        claiming, steps = perception.claim(choices[:, 1], rows)
        state.commands[claiming, 2] = 1.0
        state.commands[claiming, 3] = 2 * steps / (perception.memory.robots["steps"][claiming] + 1) - 1

    def _choose(self, state: HeadingsState, rows: np.ndarray, deterministic: bool) -> np.ndarray:
        """Return the choices `(n, 2)` of the robots `rows`."""
        perception = state.perception
        features = {name: getattr(perception.memory, name)[rows] for name in FEATURES}
        masks = {"action_masks": perception.action_masks()[rows]} if self._takes_masks else {}
        choices, _ = self.model.predict(features, deterministic=deterministic, **masks)
        return choices


class RandomHeadingsAgent(HeadingsAgent):
    """Draws headings, and claims among the candidates that there are: a baseline.

    Parameters
    ----------
    rules, action_type
        As for `HeadingsAgent`.
    seed : int
    """

    def __init__(self, rules: Rules | None = None, *, action_type: ActionType = "twist", seed: int = 0) -> None:
        super().__init__(None, rules, action_type=action_type)
        self.seed = seed

    def reseed(self, state: HeadingsState | None, seeds: Sequence[int | None]) -> HeadingsState:
        """Return the state, with the random numbers of some robots reseeded; see `ScriptedPolicy.reseed`."""
        state = state or HeadingsState(len(seeds), self.rules)
        for row, seed in enumerate(seeds):
            if seed is not None:
                state.seeds[row] = seed
        return state

    def _choose(self, state: HeadingsState, rows: np.ndarray, deterministic: bool) -> np.ndarray:
        masks, decisions = state.perception.action_masks(), state.perception.memory.robots["decisions"]
        choices = np.zeros((len(rows), 2), np.int64)
        for choice, row in zip(choices, rows, strict=True):
            rng = np.random.default_rng([self.seed, int(state.seeds[row]), int(decisions[row])])
            choice[:] = rng.integers(HEADINGS), rng.choice(np.flatnonzero(masks[row, HEADINGS:]))
        return choices
