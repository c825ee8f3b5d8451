"""Agents that drive one robot, and policies that drive a batch of robots with one such agent each."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from agents.actions import Decision, encode_action
from cyclic_env.config import ACTION_TYPES, DISTANCE_MAX, ActionType
from cyclic_env.errors import ConfigError
from cyclic_env.validation import as_array, check_choice, short_repr

EXPECTED = "a dict with the arrays laser (N, beams), distance (N, 1) and compass (N, 2)"


class Agent(ABC):
    """The agent of one robot for one episode. It owns all that it remembers; the next episode has a new agent."""

    beams: int | None = None
    """Number of beams of the laser that the agent is made for, if it remembers scans."""

    @abstractmethod
    def decide(self, scan: np.ndarray, distance: float, compass: np.ndarray) -> Decision:
        """Decide what to do, given the readings of one step.

        Parameters
        ----------
        scan : (beams,) float64
            Ranges in metres, beam 0 straight ahead, counter-clockwise.
        distance : float
            Reading of the distance meter, metres.
        compass : (2,) float64
            The heading as a vector (east, north).
        """

    @property
    def belief(self) -> np.ndarray | None:
        """Where it believes to be, from where it started: x, y, heading `(3,)`; None if it keeps no account of that."""
        return None

    def encode(self, decision: Decision, action_type: ActionType) -> tuple[float, ...]:
        """Return a decision as an action of that type."""
        return encode_action(decision, action_type)


class Readings(NamedTuple):
    """An observation of N robots, checked, in double precision."""

    laser: np.ndarray
    """`(N, beams)`, metres."""
    distance: np.ndarray
    """`(N,)`, metres."""
    compass: np.ndarray
    """`(N, 2)`, east and north."""
    single: bool
    """Whether the observation was that of one robot, without the batch axis."""


class BatchPolicy(ABC):
    """A policy with one agent for each robot, and with the `predict` of Stable-Baselines3's ``PolicyPredictor``.

    Parameters
    ----------
    action_type : {"wheels", "twist", "discrete"}
        The action type of the environment.
    """

    def __init__(self, *, action_type: ActionType = "wheels") -> None:
        self.action_type: ActionType = check_choice("action type", action_type, ACTION_TYPES)

    @abstractmethod
    def new_agent(self, beams: int, row: int, previous: Any = None) -> Agent:
        """Return the agent of the robot in a row of the batch, at the beginning of an episode.

        Parameters
        ----------
        beams : int
            Number of the laser's beams.
        row : int
        previous : Agent, optional
            The robot's agent in the episode before.
        """

    def predict(
        self,
        observation: np.ndarray | Mapping[str, np.ndarray],
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, Any]:
        """Return the robots' actions, and the agents that have chosen them.

        Parameters
        ----------
        observation : dict of arrays
            ``laser`` `(N, beams)`, metres, beam 0 straight ahead, counter-clockwise all around; ``distance`` `(N, 1)`,
            metres; ``compass`` `(N, 2)`, the heading as a vector (east, north). The axis N is absent for one robot.
        state : tuple of Agent, optional
            The state that the last call returned; its agents are updated in place. None at the first call.
        episode_start : (N,) bool, optional
            Robots whose episode has just begun.
        deterministic : bool
            Has no effect.

        Returns
        -------
        actions : (N, 4) float32, or (N, 2) int64 if discrete; without the N for one robot
        state : tuple of Agent

        Raises
        ------
        ConfigError
            If the observation is not of this form, or the state or `episode_start` belongs to other robots.
        """
        laser, distance, compass, single = read_observation(observation)
        agents = self._agents(laser.shape, state, episode_start)
        actions = [
            agent.encode(agent.decide(laser[row], float(distance[row]), compass[row]), self.action_type)
            for row, agent in enumerate(agents)
        ]
        batch = np.array(actions, np.int64 if self.action_type == "discrete" else np.float32)
        return (batch[0] if single else batch), agents

    def _agents(self, shape: tuple[int, ...], state: Any, episode_start: np.ndarray | None) -> tuple[Agent, ...]:
        """Return an agent for each row: the one in the state, or a new one where an episode begins."""
        count, beams = shape
        if state is None:
            return tuple(self.new_agent(beams, row) for row in range(count))
        if not isinstance(state, list | tuple) or not all(isinstance(agent, Agent) for agent in state):
            raise ConfigError(f"the state is {short_repr(state)}; expected what the last predict returned, or None.")
        if len(state) != count:
            raise ConfigError(
                f"the state is that of {len(state)} robots, the observation that of {count}; begin with state=None."
            )
        begun = np.zeros(count, np.bool_) if episode_start is None else np.asarray(episode_start, np.bool_).ravel()
        if len(begun) != count:
            raise ConfigError(f"episode_start is that of {len(begun)} robots, the observation that of {count}.")
        for agent, new in zip(state, begun, strict=True):
            if not new and agent.beams not in (None, beams):
                raise ConfigError(
                    f"the state is that of a laser with {agent.beams} beams, but the observation has {beams}."
                )
        return tuple(
            self.new_agent(beams, row, agent) if new else agent
            for row, (agent, new) in enumerate(zip(state, begun, strict=True))
        )


def read_observation(observation: Any) -> Readings:
    """Return the readings in an observation of one robot or of several.

    Raises
    ------
    ConfigError
        If the observation is not what `EXPECTED` says, or a reading of distance or compass is not finite and in range.
    """
    if not isinstance(observation, Mapping):
        raise ConfigError(f"the observation is {short_repr(observation)}; expected {EXPECTED}.")
    arrays = []
    for name in ("laser", "distance", "compass"):
        if name not in observation:
            raise ConfigError(f"the observation has no {name}; expected {EXPECTED}.")
        arrays.append(as_array(observation[name], f"the observation's {name}", EXPECTED, ConfigError))
    laser, distance, compass = (array.astype(np.float64) for array in arrays)
    robots = laser.shape[:-1]
    if laser.ndim not in (1, 2) or distance.shape != (*robots, 1) or compass.shape != (*robots, 2):
        shapes = ", ".join(str(array.shape) for array in arrays)
        raise ConfigError(f"the observation's arrays have the shapes {shapes}; expected {EXPECTED}.")
    if not (np.abs(distance) <= DISTANCE_MAX).all():
        raise ConfigError(f"the observation's distance is {short_repr(distance)}; expected at most {DISTANCE_MAX:g} m.")
    if not np.isfinite(compass).all():
        raise ConfigError("the observation's compass isn't finite; expected the heading as a vector (east, north).")
    return Readings(np.atleast_2d(laser), distance.reshape(-1), np.atleast_2d(compass), laser.ndim == 1)
