"""Learned agents: the environment for Stable-Baselines3, the task "headings", training, and stored models."""

from __future__ import annotations

from gymnasium.envs.registration import register, registry

from cyclic_env.errors import ConfigError

PACKAGES = ("stable_baselines3", "sb3_contrib", "torch")
"""Packages of the extra ``train``."""


def require_learning() -> None:
    """Check that the packages for learned agents are installed.

    Raises
    ------
    ConfigError
        If they aren't; the message says how to install them.
    """
    try:
        for package in PACKAGES:
            __import__(package)
    except ModuleNotFoundError as error:
        if error.name in PACKAGES:
            raise ConfigError(
                f'{error.name} is missing, and learned agents need it: pip install -e ".[train]" in the checkout.'
            ) from error
        raise


if "CyclicLoopHeadings-v0" not in registry:
    register(
        id="CyclicLoopHeadings-v0",
        entry_point="agents.rl.headings.env:CyclicLoopHeadingsEnv",
        vector_entry_point="agents.rl.headings.env:CyclicLoopHeadingsVectorEnv",
    )
