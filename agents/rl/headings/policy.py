"""Networks that are shared: one scores every heading, and another every candidate, whichever it is."""

from __future__ import annotations

import math
from typing import Any

import torch
from gymnasium import spaces
from sb3_contrib.common.maskable.policies import MaskableActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from agents.rl.headings.env import FEATURES
from agents.rl.headings.memory import CANDIDATES, HEADINGS, PER_CANDIDATE, PER_HEADING, PER_ROBOT

SIZES = (HEADINGS * PER_HEADING, CANDIDATES * PER_CANDIDATE, PER_ROBOT)


class FlatFeatures(BaseFeaturesExtractor):
    """All features of an observation in one row, in the order of `FEATURES`."""

    def __init__(self, observation_space: spaces.Dict) -> None:
        super().__init__(observation_space, features_dim=sum(SIZES))

    def forward(self, observations: dict[str, torch.Tensor]) -> torch.Tensor:
        """Return the features, `(N, sum(SIZES))`."""
        return torch.cat([observations[name].flatten(1) for name in FEATURES], dim=1)


class SharedNetworks(nn.Module):
    """Logits of headings and of claims, and what the value is read from.

    A heading is scored by its features, those of the two beside it, its angle to the robot's heading, and the
    robot's; a candidate by its features and the robot's; no claim has a score of its own. The score of a heading
    begins near a multiple of its cosine: an agent that has learnt nothing drives on.

    Parameters
    ----------
    hidden : int
        Width of the two hidden layers of a score.
    value_hidden : int
        Width of those of the value, which sees all features at once.
    """

    angles: torch.Tensor

    def __init__(self, hidden: int, value_hidden: int) -> None:
        super().__init__()
        self.latent_dim_pi, self.latent_dim_vf = HEADINGS + 1 + CANDIDATES, value_hidden
        angles = torch.arange(HEADINGS) * 2 * math.pi / HEADINGS
        self.register_buffer("angles", torch.stack([angles.cos(), angles.sin(), (2 * angles).cos()], 1))
        self.heading = _score(3 * PER_HEADING + 3 + PER_ROBOT, hidden)
        self.candidate = _score(PER_CANDIDATE + PER_ROBOT, hidden)
        self.no_claim = nn.Parameter(torch.tensor([1.0]))
        self.straight_on = nn.Parameter(torch.tensor(1.5))
        self.value = nn.Sequential(
            nn.Linear(sum(SIZES), value_hidden), nn.Tanh(), nn.Linear(value_hidden, value_hidden), nn.Tanh()
        )

    def forward(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the logits `(N, HEADINGS + 1 + CANDIDATES)` and what the value is read from."""
        return self.forward_actor(features), self.forward_critic(features)

    def forward_actor(self, features: torch.Tensor) -> torch.Tensor:
        """Return the logits."""
        count = len(features)
        headings, candidates, robot = features.split(SIZES, dim=1)
        headings = headings.view(count, HEADINGS, PER_HEADING)
        left, right = headings.roll(-1, 1), headings.roll(1, 1)
        angles = self.angles.expand(count, HEADINGS, 3)
        of_headings = torch.cat([headings, right, left, angles, robot[:, None].expand(-1, HEADINGS, -1)], 2)
        of_candidates = torch.cat(
            [candidates.view(count, CANDIDATES, PER_CANDIDATE), robot[:, None].expand(-1, CANDIDATES, -1)], 2
        )
        heading_logits = self.heading(of_headings)[..., 0] + self.straight_on * self.angles[:, 0]
        claim_logits = self.candidate(of_candidates)[..., 0]
        return torch.cat([heading_logits, self.no_claim.expand(count, 1), claim_logits], 1)

    def forward_critic(self, features: torch.Tensor) -> torch.Tensor:
        """Return what the value is read from."""
        return self.value(features)


def _score(inputs: int, hidden: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(inputs, hidden), nn.Tanh(), nn.Linear(hidden, hidden), nn.Tanh(), nn.Linear(hidden, 1)
    )


class SharedPolicy(MaskableActorCriticPolicy):
    """A policy for `MaskablePPO` whose logits are those of `SharedNetworks`.

    Parameters
    ----------
    hidden, value_hidden : int
        As for `SharedNetworks`.
    """

    def __init__(self, *arguments: Any, hidden: int = 32, value_hidden: int = 64, **settings: Any) -> None:
        self.hidden, self.value_hidden = hidden, value_hidden
        settings["features_extractor_class"] = FlatFeatures
        super().__init__(*arguments, **settings)

    def _build_mlp_extractor(self) -> None:
        self.mlp_extractor = SharedNetworks(self.hidden, self.value_hidden)  # pyright: ignore[reportAttributeAccessIssue]

    def _build(self, lr_schedule: Any) -> None:
        super()._build(lr_schedule)
        self.action_net = nn.Identity()
        networks: Any = self.mlp_extractor
        for score in (networks.heading, networks.candidate):
            nn.init.orthogonal_(score[-1].weight, 0.01)
        optimizer: Any = self.optimizer_class
        self.optimizer = optimizer(self.parameters(), lr=lr_schedule(1), **self.optimizer_kwargs)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), "hidden": self.hidden, "value_hidden": self.value_hidden}
