"""From an agent that drives one robot to a policy that drives a batch of them."""

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
    """One robot's agent. It owns all that it remembers of an episode, and is made anew for the next one."""

    beams: int | None = None
    """Beams of the laser that it is made for, if it remembers scans."""

    @abstractmethod
    def decide(self, scan: np.ndarray, distance: float, compass: np.ndarray) -> Decision:
        """Take the readings of one step, and decide what to do.

        Parameters
        ----------
        scan : (beams,) float64
            Ranges in metres, beam 0 straight ahead, counter-clockwise.
        distance : float
            What the distance meter shows, metres.
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
    """Whether the observation was of one robot, without the batch axis."""


class BatchPolicy(ABC):
    """A policy that has one agent for each robot, with the `predict` of Stable-Baselines3's ``PolicyPredictor``.

    Parameters
    ----------
    action_type : {"wheels", "twist", "discrete"}
        That of the environment.
    """

    def __init__(self, *, action_type: ActionType = "wheels") -> None:
        self.action_type: ActionType = check_choice("action type", action_type, ACTION_TYPES)

    @abstractmethod
    def new_agent(self, beams: int, row: int, previous: Any = None) -> Agent:
        """Return the agent of the robot in a row of the batch, at the beginning of an episode.

        Parameters
        ----------
        beams : int
            Of the laser.
        row : int
        previous : Agent, optional
            The one of the episode before.
        """

    def predict(
        self,
        observation: np.ndarray | Mapping[str, np.ndarray],
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, Any]:
        """Return actions, and the agents that have chosen them.

        Parameters
        ----------
        observation : dict of arrays
            ``laser`` `(N, beams)`, metres, beam 0 straight ahead, counter-clockwise all around; ``distance`` `(N, 1)`,
            metres; ``compass`` `(N, 2)`, the heading as a vector (east, north). Without the N for one robot.
        state : tuple of Agent, optional
            As returned by the last call, which this one continues: it holds the same objects. None at the first call.
        episode_start : (N,) bool, optional
            Robots whose episode has just begun.
        deterministic : bool
            Makes no difference.

        Returns
        -------
        actions : (N, 4) float32, or (N, 2) int64 if discrete; without the N for one robot
        state : tuple of Agent

        Raises
        ------
        ConfigError
            If the observation doesn't fit the above, or the state or `episode_start` is of other robots.
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
        """Return an agent for each row: that of the state, or a new one where an episode begins."""
        count, beams = shape
        if state is None:
            return tuple(self.new_agent(beams, row) for row in range(count))
        if not isinstance(state, list | tuple) or not all(isinstance(agent, Agent) for agent in state):
            raise ConfigError(f"the state is {short_repr(state)}; expected what the last predict returned, or None.")
        if len(state) != count:
            raise ConfigError(
                f"the state is of {len(state)} robots, the observation of {count}; begin with state=None."
            )
        begun = np.zeros(count, np.bool_) if episode_start is None else np.asarray(episode_start, np.bool_).ravel()
        if len(begun) != count:
            raise ConfigError(f"episode_start is of {len(begun)} robots, the observation of {count}.")
        for agent, new in zip(state, begun, strict=True):
            if not new and agent.beams not in (None, beams):
                raise ConfigError(f"the state is of a laser with {agent.beams} beams, the observation of {beams}.")
        return tuple(
            self.new_agent(beams, row, agent) if new else agent
            for row, (agent, new) in enumerate(zip(state, begun, strict=True))
        )


def read_observation(observation: Any) -> Readings:
    """Return the readings that an observation of one robot or of several holds.

    Raises
    ------
    ConfigError
        If it isn't `EXPECTED`, or a distance or compass reading is no finite number in range.
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
