"""Run one episode of a comparison, log what the agent does, and time its decisions."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from agents.comparison import load_contestant
from cyclic_env import TIERS, CyclicLoopVectorEnv
from cyclic_env.errors import CyclicLoopError
from cyclic_env.evaluation.rollout import Policy, rollout
from scripts.comparison.suite import Job


class TimeLimit(CyclicLoopError):
    """A run exceeded its time limit."""


@dataclass(slots=True)
class EpisodeLog:
    """The log of an episode, filled while it runs.

    Attributes
    ----------
    infos : list of records
        The scalars of the info before each step, as `CyclicLoopVectorEnv.info_records` has them.
    beliefs : list of (3,) arrays or None
        The agent's estimated poses, relative to the start.
    matches : list of int
        The step named by the latest claim before each record, or -1 if there was none.
    decision_s : list of float
        Seconds that each decision took.
    final : dict
        The record of the episode, as `cyclic_env.evaluation.rollout.rollout` yields it.
    last_action : array
        The policy's actions in the last step, `(1, ...)`.
    tour_m : float
        The closed tour of the plan, metres.
    """

    infos: list[Any] = field(default_factory=list)
    beliefs: list[np.ndarray | None] = field(default_factory=list)
    matches: list[int] = field(default_factory=list)
    decision_s: list[float] = field(default_factory=list)
    final: dict[str, Any] = field(default_factory=dict)
    last_action: Any = None
    tour_m: float = 0.0

    def all_infos(self) -> np.ndarray:
        """Return the infos after the reset and every step of an episode that has ended, `(t + 1,)` records."""
        infos = np.array(self.infos)
        last = np.array([tuple(self.final[name] for name in infos.dtype.names or ())], infos.dtype)
        return np.concatenate([infos, last])


class WatchedPolicy:
    """A wrapper that logs a policy's beliefs and decision times, and enforces the time limit.

    Parameters
    ----------
    policy : Policy
    env : CyclicLoopVectorEnv
        With one row.
    log : EpisodeLog
    ends : float
        When the time limit is reached, by `time.perf_counter`.
    """

    def __init__(self, policy: Policy, env: CyclicLoopVectorEnv, log: EpisodeLog, ends: float) -> None:
        self._policy, self._env, self._log, self._ends = policy, env, log, ends
        for name in ("attach", "reseed"):
            if hasattr(policy, name):
                setattr(self, name, getattr(policy, name))

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[np.ndarray, Any]:
        """Return the actions of the wrapped policy, and log them."""
        began = time.perf_counter()
        if began > self._ends:
            raise TimeLimit("it took longer than the time limit")
        answer = self._policy.predict(
            observation, state=state, episode_start=episode_start, deterministic=deterministic
        )
        self._log.decision_s.append(time.perf_counter() - began)
        claims = self._env.claims(0)
        self._log.infos.append(self._env.info_records[0].copy())
        self._log.matches.append(int(claims["match"][-1]) if len(claims) else -1)
        agent = answer[1][0] if isinstance(answer, tuple) and isinstance(answer[-1], list | tuple) else None
        belief = getattr(agent, "belief", None)
        self._log.beliefs.append(None if belief is None else np.array(belief, np.float64))
        self._log.last_action = answer[0] if isinstance(answer, tuple) else None
        return answer


def run_episode(job: Job, log: EpisodeLog, time_limit: float) -> None:
    """Run an episode and fill its log, which keeps what was done so far even if this raises.

    Raises
    ------
    Exception
        Whatever the agent raises, `TimeLimit`, or an `ActionError` for an invalid action.
    """
    tier = TIERS[job.tier].settings()
    with deadline(time_limit) as ends:
        entry = load_contestant(job.agent, map_name=job.map, **tier)
        settings = {**tier, "random_start": job.start == "random", "action_type": entry.action_type}
        env = CyclicLoopVectorEnv(1, job.map, autoreset_mode="SAME_STEP", num_threads=1, **settings)
        with closing(env):
            log.tour_m = env.floor_plans[0].closed_tour()
            (log.final,) = rollout(WatchedPolicy(entry.policy, env, log, ends), env, [job.seed])


@contextmanager
def deadline(seconds: float) -> Iterator[float]:
    """Interrupt the block after some seconds, where signals allow it; yield the deadline, by `time.perf_counter`.

    Raises
    ------
    TimeLimit
    """

    def stop(*_: Any) -> None:
        raise TimeLimit(f"a decision did not end within the time limit of {seconds:g} s")

    can_signal = hasattr(signal, "setitimer") and threading.current_thread() is threading.main_thread()
    before: Callable[..., Any] | int | None = signal.signal(signal.SIGALRM, stop) if can_signal else None
    try:
        if can_signal:
            signal.setitimer(signal.ITIMER_REAL, seconds)
        yield time.perf_counter() + seconds
    finally:
        if can_signal:
            signal.setitimer(signal.ITIMER_REAL, 0)
            signal.signal(signal.SIGALRM, before)
