"""Command lines from dataclasses: the options of all commands are fields of frozen dataclasses, read by tyro."""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro
from tyro.conf import arg

from cyclic_env.config import ClosureConfig, CoverageConfig, LaserConfig, RewardConfig, RobotConfig
from cyclic_env.errors import ConfigError
from cyclic_env.floor_plans import separate_names

T = TypeVar("T")

OptionalText = Annotated[str | None, arg(metavar="TEXT", help_behavior_hint="")]
OptionalInt = Annotated[int | None, arg(metavar="N", help_behavior_hint="")]
OptionalFloat = Annotated[float | None, arg(metavar="X", help_behavior_hint="")]
OptionalFile = Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")]
OptionalFolder = Annotated[Path | None, arg(metavar="FOLDER", help_behavior_hint="")]
Flag = Annotated[bool, arg(help_behavior_hint="")]
"""Types of options that may be left out; their help says what happens then."""


@dataclass(frozen=True, kw_only=True)
class EnvArguments:
    """Settings of `cyclic_env.EnvConfig`, without those whose defaults differ from command to command."""

    random_start: Flag = False
    """draw the start of an episode (default: the plan's own)"""
    terminate_on_collision: Flag = False
    """end an episode at the first contact with a wall"""
    step_budget: OptionalInt = None
    """longest episode, in steps (default: what the plan needs)"""
    robot: RobotConfig = field(default_factory=RobotConfig)
    laser: LaserConfig = field(default_factory=LaserConfig)
    closure: ClosureConfig = field(default_factory=ClosureConfig)
    coverage: CoverageConfig = field(default_factory=CoverageConfig)
    reward: RewardConfig = field(default_factory=RewardConfig)

    def settings(self) -> dict[str, Any]:
        """Return the settings as arguments of an environment."""
        return {entry.name: getattr(self, entry.name) for entry in fields(self)}

    def changed(self) -> dict[str, Any]:
        """Return the settings that are not the default ones."""
        default = EnvArguments()
        return {name: value for name, value in self.settings().items() if value != getattr(default, name)}


EnvOptions = Annotated[EnvArguments, arg(name="")]
"""The environment's settings as options without a prefix: ``--noise``, ``--laser.num-beams``."""


def noise_presets(text: str) -> Any:
    """Return the noise preset in a text, or a tuple of several with commas between."""
    names = tuple(separate_names(text))
    return names[0] if len(names) == 1 else names


def parse(kind: type[T], arguments: Sequence[str] | None, prog: str, description: str) -> T:
    """Return the options of a command line; exit after ``--help``.

    Raises
    ------
    ConfigError
        If they don't fit; with one line in place of tyro's box.
    """
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            return tyro.cli(
                kind, args=arguments, prog=prog, description=description, config=(tyro.conf.FlagCreatePairsOff,)
            )
    except SystemExit as end:
        if end.code in (0, None):
            raise
    raise ConfigError(one_line(said.getvalue()))


def one_line(box: str) -> str:
    """Return the message in a box of tyro's as one line, with the option that was perhaps meant."""
    plain = re.sub(r"\x1b\[[0-9;]*m|[│╰╯]", "", box)  # without colours and frame
    _, first, *_ = re.split(r"^.*?(?:─{4,}|-{4,}).*$", plain, flags=re.MULTILINE)  # the title is in the frame, or first
    message = " ".join(re.split(r"\n\s*\n", first.strip())[0].split()).rstrip(".")
    message = re.sub(r"^Error parsing \S+: (?=\w+Config\.)", "", message)
    message = re.sub(
        r"^Error parsing (\S+): no type matching (?:\{None\}\|)?\{?([^{}]+?)\}? could be instantiated from \[(.*)\]",
        r"\1 is \3; expected \2",
        message,
    )
    meant = re.search(r"Perhaps you meant:\s*(--[\w.-]+)", plain)
    hint = f" Did you mean {meant[1]}?" if meant else ""
    return f"{message}.{hint} --help lists all options."
