"""The features that are the input of a network."""

from __future__ import annotations

import torch
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

DISTANCE_SCALE = 200.0
"""Metres of travel at which tanh(distance / scale) is three quarters of its maximum; some laps of a block."""


class ScanFeatures(BaseFeaturesExtractor):
    """The observation, scaled so that all its numbers have about the same magnitude.

    Ranges are divided by the laser's reach. The distance, which has no bound, becomes
    tanh(distance / `DISTANCE_SCALE`). The compass is a unit vector already. The scaling is part of the policy and
    saved with it, so a model takes the environment's observations unchanged in any harness.

    Parameters
    ----------
    observation_space : Dict
        The observation space of a `CyclicLoopEnv`.
    """

    def __init__(self, observation_space: spaces.Dict) -> None:
        super().__init__(
            observation_space, features_dim=sum(spaces.flatdim(space) for space in observation_space.values())
        )
        laser = observation_space["laser"]
        assert isinstance(laser, spaces.Box)
        self.range_max = float(laser.high.max())

    def forward(self, observations: dict[str, torch.Tensor]) -> torch.Tensor:
        """Return the features, `(N, beams + 3)`."""
        return torch.cat(
            [
                observations["laser"] / self.range_max,
                torch.tanh(observations["distance"] / DISTANCE_SCALE),
                observations["compass"],
            ],
            dim=1,
        )
