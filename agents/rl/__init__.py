"""Learned agents: the environment as Stable-Baselines3 wants it, training, and stored models."""

from __future__ import annotations

from cyclic_env.errors import ConfigError

PACKAGES = ("stable_baselines3", "torch")
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
