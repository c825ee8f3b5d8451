"""All settings, as frozen dataclasses that are checked when they are made.

Lengths are in metres, times in seconds, angles in radians unless a name ends in ``_deg``. Every class
can be given to the environment as an instance or as a plain mapping of its fields (which is what an
environment spec holds after a trip through JSON).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Literal, TypeVar

from cyclic_env.errors import ConfigError
from cyclic_env.validation import check_choice, check_field, check_integer, check_number, unknown_name

ActionType = Literal["wheels", "twist", "discrete"]
ACTION_TYPES: tuple[ActionType, ...] = ("wheels", "twist", "discrete")

T = TypeVar("T")


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotConfig:
    """A round differential-drive robot, by default a Pioneer P3-DX."""

    radius: float = 0.25
    axle_track: float = 0.40
    wheel_speed_max: float = 1.2
    """Full speed of a wheel, m/s."""
    wheel_time_constant: float = 0.15
    """First-order lag between the commanded and the actual wheel speed, s; 0 means none."""
    mass: float = 9.0
    dt: float = 0.2
    """Length of a control step, s."""
    substeps: int = 4
    """Physics steps in a control step. A robot sinks into a wall by less than what it drives in one: 0.06 m."""

    def __post_init__(self) -> None:
        for field in ("radius", "axle_track", "wheel_speed_max", "mass", "dt"):
            check_number(self, field, 1e-3, 1e3)
        check_number(self, "wheel_time_constant", 0.0)
        check_integer(self, "substeps", 1, 1000)
        advance = self.wheel_speed_max * self.dt / self.substeps
        check_field(
            self,
            advance <= self.radius / 2,
            "substeps",
            f"enough that a substep drives at most half the radius (now {advance:.3g} m of {self.radius:.3g} m)",
        )

    @property
    def advance_max(self) -> float:
        """The longest way that the robot drives in a control step, metres."""
        return self.wheel_speed_max * self.dt


@dataclass(frozen=True, slots=True, kw_only=True)
class LaserConfig:
    """A scanner with evenly spaced beams all around, by default an RPLIDAR A1; beam 0 points straight ahead."""

    num_beams: int = 180
    range_max: float = 12.0

    def __post_init__(self) -> None:
        check_integer(self, "num_beams", 4, 7200)
        check_number(self, "range_max", 0.0, 1000.0, open_low=True)

    @property
    def beam_spacing(self) -> float:
        """Angle from one beam to the next, counter-clockwise, radians."""
        return 2 * math.pi / self.num_beams


@dataclass(frozen=True, slots=True, kw_only=True)
class NoiseConfig:
    """How far the three sensors err; the presets are in `NOISE_PRESETS`, all zeros is the paper's world.

    The laser's terms are those of the beam model (Thrun, Burgard and Fox, Probabilistic Robotics, 6.3):
    with the given probabilities a range is cut short, reads the maximum, or is random; else it is the
    true one with Gaussian noise.
    """

    distance_scale: float = 0.0
    """Standard deviation of the distance meter's scale error, drawn once an episode (1 = 100 %)."""
    distance_drift: float = 0.0
    """Random walk of the distance meter, metres per square root of a metre driven."""
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
    laser_max: float = 0.0
    laser_random: float = 0.0

    def __post_init__(self) -> None:
        for field in ("distance_drift", "compass_white_deg", "compass_field_deg", "laser_sigma"):
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
    def laser_is_exact(self) -> bool:
        """Whether the laser reads the true ranges."""
        terms = (self.laser_sigma, self.laser_sigma_relative, self.laser_short, self.laser_max, self.laser_random)
        return not any(terms)


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
    "poor": NoiseConfig(
        distance_scale=0.05,
        distance_drift=0.05,
        compass_field_deg=13.0,
        laser_sigma_relative=0.035,
        laser_short=0.05,
        laser_max=0.05,
        laser_random=0.02,
    ),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class ClosureConfig:
    """What counts as being back, and which claims of it are judged; see `cyclic_env.task.loop_closure`."""

    return_radius: float = 3.0
    """Greatest distance between two positions that are the same place."""
    gap: float = 20.0
    """Least path length between leaving a place and being back."""
    leave_radius: float = 10.0
    """The robot must have been this far away in between."""
    event_gap: float = 2.0
    """Runs of revisit steps less than this much path apart are one event."""
    event_length_min: float = 1.0
    """Shorter events count neither way."""
    claim_spacing: float = 2.0
    """Path that must pass since the last judged claim before another is judged."""

    def __post_init__(self) -> None:
        check_number(self, "return_radius", 0.1)
        check_number(self, "gap", 0.0, open_low=True)
        for field in ("event_gap", "event_length_min", "claim_spacing"):
            check_number(self, field, 0.0)
        check_number(self, "leave_radius", self.return_radius, open_low=True)


@dataclass(frozen=True, slots=True, kw_only=True)
class CoverageConfig:
    """How the building is divided into cells, and how often a scan marks what it has seen."""

    cell_size: float = 0.5
    scan_spacing: float = 0.5
    """Path length between two scans that mark cells."""
    complete: float = 0.99
    """Share of the cells that must be seen for success."""

    def __post_init__(self) -> None:
        check_number(self, "cell_size", 0.05)
        check_number(self, "scan_spacing", 0.0)
        check_field(
            self,
            self.scan_spacing == 0 or self.scan_spacing >= 1e-3,
            "scan_spacing",
            "0 (every step) or at least 0.001",
        )
        check_number(self, "complete", 0.0, 1.0, open_low=True)


@dataclass(frozen=True, slots=True, kw_only=True)
class RewardConfig:
    """Weights of the reward's terms; a perfect run is worth 100 less its time."""

    coverage: float = 50.0
    """For seeing the whole free area; doubled where the plan has no cycle."""
    new_cycle: float = 50.0
    """For closing all cycles of the plan, in equal shares."""
    false_claim: float = -5.0
    missed_revisit: float = -1.0
    collision: float = -40.0
    """For a whole step budget spent in contact with a wall."""
    time: float = -10.0
    """For a whole step budget."""

    def __post_init__(self) -> None:
        for field in fields(self):
            check_number(self, field.name, -1e6, 1e6)


def from_mapping(cls: type[T], value: T | Mapping[str, Any] | None) -> T:
    """Return `value` as an instance of the settings class `cls`.

    Parameters
    ----------
    cls : type
        One of the dataclasses of this module.
    value : cls, mapping or None
        An instance (returned as it is), some of the fields by name, or None for the defaults.

    Raises
    ------
    ConfigError
        If a field is unknown (the message names the nearest) or out of range.
    """
    if value is None:
        return cls()
    if isinstance(value, cls):
        return value
    if not isinstance(value, Mapping):
        raise ConfigError(f"expected a {cls.__name__} or a mapping of its fields, got {type(value).__name__}.")
    known = {field.name for field in fields(cls)}  # pyright: ignore[reportArgumentType]
    for key in value:
        if key not in known:
            raise ConfigError(unknown_name(f"field of {cls.__name__}", key, known))
    return cls(**value)


def noise_from_name(noise: str | NoiseConfig | Mapping[str, Any] | None) -> NoiseConfig:
    """Return the noise preset of that name, or `noise` itself where it already is a setting.

    Raises
    ------
    ConfigError
        If there is no such preset; the message lists them.
    """
    if noise is None:
        raise ConfigError(f"noise is None; expected a preset ({', '.join(NOISE_PRESETS)}) or a NoiseConfig.")
    if isinstance(noise, str):
        return NOISE_PRESETS[check_choice("noise preset", noise, NOISE_PRESETS)]
    return from_mapping(NoiseConfig, noise)
