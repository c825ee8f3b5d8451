"""Base classes: an agent drives one robot, and a policy drives a batch of robots with one agent each."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from agents.actions import Decision, encode_action
from cyclic_env.config import ACTION_TYPES, DISTANCE_MAX, ActionType
from cyclic_env.errors import ConfigError
from cyclic_env.validation import as_array, check_choice, short_repr

OBSERVATION_FORM = (
    "a dict with the arrays laser (N, beams), distance (N, 1) and compass (N, 2) (without N for a single robot)"
)


class Agent(ABC):
    """The agent of one robot for one episode. It owns all that it remembers; the next episode has a new agent."""

    beams: int | None = None
    """Beam count that the agent requires, or None if any will do."""

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
        """Estimated pose (x, y, heading) `(3,)`; None if the agent doesn't track its pose.

        The position is relative to the start, in metres east and north; the heading is in radians.
        """
        return None

    def encode(self, decision: Decision, action_type: ActionType) -> tuple[float, ...]:
        """Encode a decision as an action of the environment's action type."""
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
    """True if the input had no batch axis."""


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
        """Return the agent that drives the robot in a row of the batch for one episode; called as the episode starts.

        Parameters
        ----------
        beams : int
            Number of laser beams.
        row : int
        previous : Agent, optional
            The agent that drove this robot in the previous episode; None if there was no such episode.
        """

    def predict(
        self,
        observation: np.ndarray | Mapping[str, np.ndarray],
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, Any]:
        """Return the robots' actions, and the agents that chose them.

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
            Ignored; present for SB3 compatibility.

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
        agents = self._agents_for_rows(laser.shape, state, episode_start)
        actions = [
            agent.encode(agent.decide(laser[row], float(distance[row]), compass[row]), self.action_type)
            for row, agent in enumerate(agents)
        ]
        batch = np.array(actions, np.int64 if self.action_type == "discrete" else np.float32)
        return (batch[0] if single else batch), agents

    def _agents_for_rows(
        self, shape: tuple[int, ...], state: Any, episode_start: np.ndarray | None
    ) -> tuple[Agent, ...]:
        """Return an agent for each row: the one in the state, or a new one where an episode starts."""
        num_rows, beams = shape
        if state is None:
            return tuple(self.new_agent(beams, row) for row in range(num_rows))
        if not isinstance(state, list | tuple) or not all(isinstance(agent, Agent) for agent in state):
            raise ConfigError(f"the state is {short_repr(state)}; expected what the last predict returned, or None.")
        if len(state) != num_rows:
            raise ConfigError(
                f"the state holds {len(state)} agents, but the observation has {num_rows} robots; "
                "pass state=None to start afresh."
            )
        starts = np.zeros(num_rows, np.bool_) if episode_start is None else np.asarray(episode_start, np.bool_).ravel()
        if len(starts) != num_rows:
            raise ConfigError(f"episode_start has {len(starts)} entries, but the observation has {num_rows} robots.")
        agents = []
        for row, (agent, is_start) in enumerate(zip(state, starts, strict=True)):
            fits = agent.beams is None or agent.beams == beams
            if not is_start and not fits:
                raise ConfigError(f"the agent expects {agent.beams} beams, but the observation has {beams}.")
            agents.append(self.new_agent(beams, row, agent) if is_start else agent)
        return tuple(agents)


def read_observation(observation: Any) -> Readings:
    """Return the checked readings in an observation of one robot or of several.

    Raises
    ------
    ConfigError
        If the observation is not of the form `OBSERVATION_FORM`, or the distance or the compass is not finite, or the
        distance is out of range.
    """
    if not isinstance(observation, Mapping):
        raise ConfigError(f"the observation is {short_repr(observation)}; expected {OBSERVATION_FORM}.")
    arrays = []
    for name in ("laser", "distance", "compass"):
        if name not in observation:
            raise ConfigError(f"the observation has no {name}; expected {OBSERVATION_FORM}.")
        arrays.append(as_array(observation[name], f"the observation's {name}", OBSERVATION_FORM, ConfigError))
    laser, distance, compass = (array.astype(np.float64) for array in arrays)
    batch_shape = laser.shape[:-1]
    if laser.ndim not in (1, 2) or distance.shape != (*batch_shape, 1) or compass.shape != (*batch_shape, 2):
        shapes = ", ".join(str(array.shape) for array in arrays)
        raise ConfigError(f"the observation's arrays have the shapes {shapes}; expected {OBSERVATION_FORM}.")
    if not (np.abs(distance) <= DISTANCE_MAX).all():  # written so that NaN fails, too
        raise ConfigError(f"the observation's distance is {short_repr(distance)}; expected at most {DISTANCE_MAX:g} m.")
    if not np.isfinite(compass).all():
        raise ConfigError("the observation's compass isn't finite; expected the heading as a vector (east, north).")
    return Readings(np.atleast_2d(laser), distance.reshape(-1), np.atleast_2d(compass), laser.ndim == 1)
