"""Callbacks of a training: curves, scores on validation plans, and checkpoints from which runs resume exactly."""

from __future__ import annotations

import csv
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.vector import VectorEnv
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import set_random_seed

from agents.rl.validation import first_episodes
from cyclic_env.atomic_write import write_text_atomically

LOOP_MEASURES = ("cycles_closed", "cycles_total", "claims", "false_claims", "precision", "recall")
MEASURES = (*LOOP_MEASURES, "coverage", "collisions", "is_success", "path_length_m")
RECENT_EPISODES = 100
FALSE_CLAIM_COST = 10.0
"""What a false claim costs when models are compared, beyond the return. Returns that differ by less than chance can
hide twice as many false claims, and a map bears none."""


class Curves(BaseCallback):
    """Hands the means of the latest episodes, loop measures and reward terms among them, to the model's logger."""

    def _on_training_start(self) -> None:
        self._episodes: deque[dict[str, float]] = deque(maxlen=RECENT_EPISODES)

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            if "episode" in info:
                terms = {f"reward/{name}": value for name, value in info["episode"]["terms"].items()}
                self._episodes.append({**{f"loop/{name}": float(info[name]) for name in MEASURES}, **terms})
        return True

    def _on_rollout_end(self) -> None:
        for name in self._episodes[0] if self._episodes else ():
            self.logger.record(name, float(np.mean([episode[name] for episode in self._episodes])))


class Validation(BaseCallback):
    """Scores the model at intervals, by first episodes on plans that it is not trained on, and keeps the best one.

    Parameters
    ----------
    make_env : callable
        Returns the environment for the scores, with autoreset mode ``DISABLED``.
    every : int
        Steps between two scores.
    path : path
        File of the scores, one per line.
    keep : callable
        Called with the model whenever it scores better than ever before.
    seed : int
    """

    def __init__(
        self,
        make_env: Callable[[], VectorEnv],
        every: int,
        path: Path,
        keep: Callable[[BaseAlgorithm], None],
        seed: int = 0,
    ) -> None:
        super().__init__()
        self._make_env, self._every, self._path, self._keep, self._seed = make_env, every, path, keep, seed

    def _on_training_start(self) -> None:
        self._last = self.num_timesteps // self._every
        self._rows = cut_back(self._path, self.num_timesteps)
        self._best = max((_merit(row) for row in self._rows), default=-np.inf)

    def _on_rollout_start(self) -> None:
        """Score the model after the update, where this is due."""
        if self.num_timesteps // self._every > self._last:
            self._last = self.num_timesteps // self._every
            self.score()

    def _on_step(self) -> bool:
        return True

    def _on_training_end(self) -> None:
        if not self._rows or int(self._rows[-1]["steps"]) < self.num_timesteps:
            self.score()

    def score(self) -> None:
        """Score the model as it is, and write a line."""
        env = self._make_env()
        try:
            records = first_episodes(self.model, env, self._seed)
        finally:
            env.close()
        means = {name: float(np.mean([record[name] for record in records])) for name in ("return", *MEASURES)}
        self._rows.append({"steps": self.num_timesteps, "plans": len(records), **means})
        lines = [",".join(self._rows[0])]
        lines += [",".join(str(value) for value in row.values()) for row in self._rows]
        write_text_atomically(self._path, "\n".join(lines) + "\n")
        for name, value in means.items():
            self.logger.record(f"validation/{name}", value)
        if _merit(means) > self._best:
            self._best = _merit(means)
            self._keep(self.model)


def _merit(scores: Mapping[str, Any]) -> float:
    """Return by what models are compared."""
    return float(scores["return"]) - FALSE_CLAIM_COST * float(scores["false_claims"])


class Checkpoints(BaseCallback):
    """Saves the model at intervals, so that a resumed run continues as if it had not been stopped.

    At each checkpoint all episodes begin anew, with seeds and random numbers that depend only on the run's seed and the
    number of steps done, so that nothing but the model with its optimizer has to be saved. (Robots in contact with a
    wall can't be copied to the bit, and the maps of hundreds of robots are large.)

    Parameters
    ----------
    every : int
        Steps between two checkpoints; an update ends before each.
    seed : int
    save : callable
        Called with the model.
    """

    def __init__(self, every: int, seed: int, save: Callable[[BaseAlgorithm], None]) -> None:
        super().__init__()
        self._every, self._seed, self._save = every, seed, save

    def _on_training_start(self) -> None:
        self._last = self.num_timesteps // self._every

    def _on_rollout_start(self) -> None:
        """Save the model after the update, where this is due."""
        if self.num_timesteps // self._every > self._last:
            self._last = self.num_timesteps // self._every
            self._save(self.model)
            begin_anew(self.model, self._seed)

    def _on_step(self) -> bool:
        return True


def begin_anew(model: BaseAlgorithm, seed: int) -> None:
    """Begin episodes in all rows of the model's environment; random numbers depend on the seed and the steps done."""
    env = model.get_env()
    assert env is not None
    seeds = np.random.SeedSequence([seed, model.num_timesteps]).generate_state(2)
    set_random_seed(int(seeds[0]))
    model.action_space.seed(int(seeds[0]))
    env.seed(int(seeds[1]))
    model._last_obs = env.reset()  # pyright: ignore[reportAttributeAccessIssue]
    model._last_episode_starts = np.ones(env.num_envs, np.bool_)


def cut_back(path: Path, steps: int) -> list[dict[str, Any]]:
    """Return the rows of a CSV file whose column ``steps`` is at most `steps`; none if there is no file."""
    if not steps or not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return [row for row in csv.DictReader(file) if row["steps"].isdecimal() and int(row["steps"]) <= steps]
