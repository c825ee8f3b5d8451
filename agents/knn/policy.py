"""The explorer for a batch of robots."""

from __future__ import annotations

from typing import Any

from agents.base import BatchPolicy
from agents.knn.config import ExplorerConfig, preset
from agents.knn.explorer import KnnExplorer
from cyclic_env.config import ActionType
from cyclic_env.errors import ConfigError
from cyclic_env.validation import short_repr


class KnnPolicy(BatchPolicy):
    """A `KnnExplorer` for each robot; these are the state that `predict` returns.

    Parameters
    ----------
    config : ExplorerConfig, optional
        By default the preset ``extended``.
    action_type : {"wheels", "twist", "discrete"}
        That of the environment.
    """

    def __init__(self, config: ExplorerConfig | None = None, *, action_type: ActionType = "wheels") -> None:
        super().__init__(action_type=action_type)
        if config is not None and not isinstance(config, ExplorerConfig):
            raise ConfigError(f"the config is {short_repr(config)}; expected an ExplorerConfig, as preset() makes.")
        self.config = preset("extended") if config is None else config

    def new_agent(self, beams: int, row: int, previous: Any = None) -> KnnExplorer:
        """Return an explorer that remembers nothing."""
        return KnnExplorer(self.config, beams)
