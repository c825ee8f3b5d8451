"""Errors of the sensors: `NoiseConfig`, and the presets by name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

from cyclic_env.validation import check_choice, check_field, check_number, from_mapping

NoisePreset = Literal["ideal", "calibrated", "typical", "poor", "hard"]


@dataclass(frozen=True, slots=True, kw_only=True)
class NoiseConfig:
    """Errors of the three sensors, by default none, as in the paper. `NOISE_PRESETS` holds the presets.

    The laser's terms are those of the beam model (Thrun, Burgard and Fox, Probabilistic Robotics, 6.3): with the given
    probabilities a range is too short, reads the maximum, or is random; otherwise it is the true one with Gaussian
    noise.
    """

    distance_scale: float = 0.0
    """Standard deviation of the distance meter's scale error, drawn once an episode (1 = 100 %)."""
    distance_drift: float = 0.0
    """Random walk of the distance meter, metres per square root of a metre driven."""
    slip_rate: float = 0.0
    """How often the wheels slip, per metre driven."""
    slip_length: float = 0.0
    """Mean of the way that a slip adds to the distance meter, metres; exponentially distributed. The meter counts turns
    of the wheels, so a slip always adds in the direction in which the robot drives."""
    compass_white_deg: float = 0.0
    """Standard deviation of the compass's white noise, degrees."""
    compass_field_deg: float = 0.0
    """Standard deviation of the building's magnetic disturbance, degrees, fixed for an episode."""
    compass_field_length: float = 10.0
    """Correlation length of the disturbance (squared-exponential), metres."""
    laser_sigma: float = 0.0
    """Standard deviation of a range, metres."""
    laser_sigma_relative: float = 0.0
    """Standard deviation of a range, as a share of the range; adds to `laser_sigma`."""
    laser_short: float = 0.0
    """Probability that a range is cut short, to a uniform draw below the true one."""
    laser_max: float = 0.0
    """Probability that a beam reads the laser's maximum."""
    laser_random: float = 0.0
    """Probability that a range is a uniform draw up to the maximum."""

    def __post_init__(self) -> None:
        for field in (
            "distance_drift",
            "slip_rate",
            "slip_length",
            "compass_white_deg",
            "compass_field_deg",
            "laser_sigma",
        ):
            check_number(self, field, 0.0, 1e3)
        for field in ("distance_scale", "laser_sigma_relative", "laser_short", "laser_max", "laser_random"):
            check_number(self, field, 0.0, 1.0)
        check_number(self, "compass_field_length", 1e-3)
        check_field(
            self,
            self.laser_short + self.laser_max + self.laser_random <= 1.0,
            "laser_random",
            "laser_short + laser_max + laser_random of at most 1",
        )

    @property
    def wheels_slip(self) -> bool:
        """Whether the distance meter counts slips of the wheels."""
        return self.slip_rate > 0 and self.slip_length > 0

    @property
    def laser_is_exact(self) -> bool:
        """Whether the laser reads the true ranges."""
        terms = (self.laser_sigma, self.laser_sigma_relative, self.laser_short, self.laser_max, self.laser_random)
        return not any(terms)


_POOR = NoiseConfig(
    distance_scale=0.05,
    distance_drift=0.05,
    compass_field_deg=13.0,
    laser_sigma_relative=0.035,
    laser_short=0.05,
    laser_max=0.05,
    laser_random=0.02,
)

NOISE_PRESETS: Mapping[str, NoiseConfig] = {
    "ideal": NoiseConfig(),
    "calibrated": NoiseConfig(
        distance_scale=0.005,
        distance_drift=0.01,
        compass_white_deg=1.0,
        compass_field_deg=3.0,
        laser_sigma=0.02,
        laser_short=0.01,
        laser_max=0.01,
        laser_random=0.005,
    ),
    "typical": NoiseConfig(
        distance_scale=0.02,
        distance_drift=0.03,
        compass_white_deg=2.0,
        compass_field_deg=8.0,
        laser_sigma=0.03,
        laser_short=0.03,
        laser_max=0.02,
        laser_random=0.01,
    ),
    "poor": _POOR,
    "hard": replace(_POOR, slip_rate=0.04, slip_length=0.3),
}
"""Errors of the sensors by name. The wheels of ``hard`` slip: a wheel that loses its grip turns on without moving the
robot, one of the non-systematic errors that no calibration removes (J. Borenstein and L. Feng, "Measurement and
correction of systematic odometry errors in mobile robots", IEEE Trans. Robotics and Automation 12(6), 1996). The mean
length is half a turn of a Pioneer's wheel, which is 195 mm wide. One slip in 25 m, as at a sill, a cable or a wet spot,
is our estimate; we know of no source for a rate."""


def noise_from_name(noise: str | NoiseConfig | Mapping[str, Any] | None) -> NoiseConfig:
    """Return the noise preset of that name, or the NoiseConfig that `noise` is or gives the fields of.

    Raises
    ------
    ConfigError
        If there is no such preset (the message lists them all), or a field is wrong.
    """
    if isinstance(noise, str):
        return NOISE_PRESETS[check_choice("noise preset", noise, NOISE_PRESETS)]
    return from_mapping(NoiseConfig, noise)
