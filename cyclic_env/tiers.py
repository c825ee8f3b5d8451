"""Tiers of difficulty, in which agents are compared."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from cyclic_env.config import LaserConfig
from cyclic_env.noise import NoisePreset


@dataclass(frozen=True, slots=True, kw_only=True)
class Tier:
    """A level of difficulty in comparisons: errors of the sensors, and the laser."""

    noise: NoisePreset
    laser: LaserConfig = field(default_factory=LaserConfig)
    ranked: bool = True
    """Whether agents are ranked by it. With ideal sensors dead reckoning alone recognizes every place."""

    def settings(self) -> dict[str, Any]:
        """Return the settings of an environment of this tier."""
        return {"noise": self.noise, "laser": self.laser}


TIERS: Mapping[str, Tier] = {
    "ideal": Tier(noise="ideal", ranked=False),
    "calibrated": Tier(noise="calibrated"),
    "typical": Tier(noise="typical"),
    "poor": Tier(noise="poor"),
    "hard": Tier(noise="hard", laser=LaserConfig(num_beams=180, range_max=8.0, field_of_view=1.5 * math.pi)),
}
"""The tiers by name. The laser of ``hard`` sees 270 degrees and 8 m, as one built into a body does: a SICK TiM561 sees
270 degrees, and dark walls (10 % remission) up to 8 m."""
