"""All settings of an environment: `EnvConfig` and its parts, frozen dataclasses that check their fields.

Lengths are in metres, times in seconds, angles in radians unless a name ends in ``_deg``. Wherever one of these classes
is expected, a mapping of some of its fields will do; the others keep their defaults.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from cyclic_env.noise import NOISE_PRESETS, NoiseConfig, NoisePreset, noise_from_name
from cyclic_env.validation import check_bool, check_choice, check_field, check_integer, check_number, from_mapping

ActionType = Literal["wheels", "twist", "discrete"]
ACTION_TYPES: tuple[ActionType, ...] = get_args(ActionType)

STEP_BUDGET_MAX = 10_000_000

DISTANCE_MAX = 1e5
"""The greatest reading of the distance meter, forwards and backwards, m."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotConfig:
    """A round differential-drive robot, by default a Pioneer P3-DX."""

    radius: float = 0.25
    """Radius of the body, m."""
    axle_track: float = 0.40
    """Distance between the wheels, m."""
    wheel_speed_max: float = 1.2
    """Full speed of a wheel, m/s."""
    wheel_time_constant: float = 0.15
    """First-order lag between the commanded and the actual wheel speed, s; 0 means none."""
    mass: float = 9.0
    """Mass, kg."""
    dt: float = 0.2
    """Length of a control step, s."""
    substeps: int = 4
    """Physics steps in a control step. A robot sinks into a wall by less than it drives in one of them: 0.06 m."""

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
        """The greatest distance that the robot can drive in a control step, m."""
        return self.wheel_speed_max * self.dt


@dataclass(frozen=True, slots=True, kw_only=True)
class LaserConfig:
    """A scanner with evenly spaced beams, by default an RPLIDAR A1, which sees all around.

    If it sees all around, beam 0 points where the laser points, by default straight ahead. Otherwise beam 0 is at the
    right edge of the field of view, and the last beam at its left edge.
    """

    num_beams: int = 180
    """Number of beams, spread over the field of view."""
    range_max: float = 12.0
    """The greatest range that the laser measures, m."""
    field_of_view: float = 2 * math.pi
    """Angle that the laser sees, radians; 2 pi means all around."""
    mounting_angle: float = 0.0
    """Angle from the robot's heading to where the laser points, counter-clockwise, radians."""

    def __post_init__(self) -> None:
        check_integer(self, "num_beams", 4, 7200)
        check_number(self, "range_max", 0.0, 1000.0, open_low=True)
        check_number(self, "field_of_view", 0.0, 2 * math.pi, open_low=True)
        check_number(self, "mounting_angle", -2 * math.pi, 2 * math.pi)

    @property
    def sees_all_around(self) -> bool:
        """Whether the field of view is a full turn."""
        return self.field_of_view == 2 * math.pi

    @property
    def beam_spacing(self) -> float:
        """Angle from one beam to the next, counter-clockwise, radians."""
        return self.field_of_view / (self.num_beams if self.sees_all_around else self.num_beams - 1)

    @property
    def first_bearing(self) -> float:
        """Bearing of beam 0, the angle from the robot's heading to it, radians."""
        return self.mounting_angle - (0.0 if self.sees_all_around else 0.5 * self.field_of_view)

    @property
    def bearings(self) -> np.ndarray:
        """Bearing of every beam, radians, `(num_beams,)`."""
        return self.first_bearing + self.beam_spacing * np.arange(self.num_beams)


@dataclass(frozen=True, slots=True, kw_only=True)
class ClosureConfig:
    """What counts as a return, and which claims of one are judged; see `cyclic_env.task.loop_closure`."""

    return_radius: float = 3.0
    """Greatest distance between two positions that count as the same place, m."""
    gap: float = 20.0
    """Least path length between two visits of a place that makes the second one a return, m."""
    leave_radius: float = 10.0
    """How far away the robot must have been between the two visits, m."""
    event_gap: float = 2.0
    """Path length, m; runs of fresh revisit steps with less than this between them are one event."""
    event_length_min: float = 1.0
    """Least path length of an event that counts, m."""
    claim_spacing: float = 2.0
    """Path length after a judged claim before the next one is judged, m."""
    sight_given: float = 0.0
    """Distance below which two positions are always in sight of each other, m."""
    wall_tolerance: float = 0.0
    """How deep a line of sight may run into the walls, m. Trajectories of real robots need it, since they don't fit a
    floor plan exactly; walls of less than twice this thickness then block no sight."""

    def __post_init__(self) -> None:
        check_number(self, "return_radius", 0.1)
        check_number(self, "gap", 0.0, open_low=True)
        for field in ("event_gap", "event_length_min", "claim_spacing", "sight_given", "wall_tolerance"):
            check_number(self, field, 0.0)
        check_number(self, "leave_radius", self.return_radius, open_low=True)


@dataclass(frozen=True, slots=True, kw_only=True)
class CoverageConfig:
    """The cells in which coverage is counted, and how often a scan marks the cells that it sees."""

    cell_size: float = 0.5
    """Side of a cell, m."""
    scan_spacing: float = 0.5
    """Path length between two scans that mark cells, m; 0 means that every scan does."""
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
    """Weights of the reward's terms; a perfect episode is worth 100 less its time."""

    coverage: float = 50.0
    """For seeing the whole free area; doubled where the plan has no cycle."""
    new_cycle: float = 50.0
    """For closing all cycles of the plan, in equal shares."""
    false_claim: float = -5.0
    """For each false claim."""
    missed_revisit: float = -1.0
    """For each revisit event that passes without a correct claim."""
    collision: float = -40.0
    """For a whole step budget in contact with a wall."""
    time: float = -10.0
    """For a whole step budget."""

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            check_number(self, name, -1e6, 1e6)


@dataclass(frozen=True, slots=True, kw_only=True)
class EnvConfig:
    """All settings of an environment; `CyclicLoopEnv` and `CyclicLoopVectorEnv` take each of them as an argument, too.

    Raises
    ------
    ConfigError
        If a setting is unknown, of the wrong type or out of range.
    """

    map_name: str | tuple[str, ...] = "killian_court"
    """A shipped floor plan, a YAML file, or a generated building such as generated:cycles=4,seed=7. Of several, or
    of the split generated:train, every reset draws one."""
    noise: NoisePreset | NoiseConfig | tuple[NoisePreset | NoiseConfig, ...] = "ideal"
    """Errors of the sensors. Given several, every reset draws one for each robot."""
    action_type: ActionType = "wheels"
    """What an action says: two wheel speeds, a twist (v, omega), or one of five drives."""
    random_start: bool = False
    """Draw the start of an episode from all reachable positions instead of taking the plan's own."""
    terminate_on_collision: bool = False
    """End an episode at the first contact with a wall; the rest of its step budget is charged as time."""
    step_budget: int | None = None
    """Steps after which an episode is truncated. The default suffices to drive three times through
    corridors 2 m wide with the plan's area."""
    robot: RobotConfig = RobotConfig()
    laser: LaserConfig = LaserConfig()
    closure: ClosureConfig = ClosureConfig()
    coverage: CoverageConfig = CoverageConfig()
    reward: RewardConfig = RewardConfig()

    def __post_init__(self) -> None:
        names = [self.map_name] if isinstance(self.map_name, str) else self.map_name
        is_name = isinstance(names, list | tuple) and names and all(isinstance(name, str) and name for name in names)
        check_field(self, bool(is_name), "map_name", "the name of a floor plan, or several")
        check_choice("action type", self.action_type, ACTION_TYPES)
        check_bool(self, "random_start")
        check_bool(self, "terminate_on_collision")
        if self.step_budget is not None:
            check_integer(self, "step_budget", 1, STEP_BUDGET_MAX)
        given: Any = self.noise
        several = isinstance(given, list | tuple)
        noise = tuple(given) if several else (given,)
        check_field(self, len(noise) > 0, "noise", "a noise preset, a NoiseConfig, or several")
        checked_noise = [(one, noise_from_name(one)) for one in noise]
        noise = tuple(one if isinstance(one, str) else config for one, config in checked_noise)
        checked = {
            "map_name": self.map_name if isinstance(self.map_name, str) else tuple(names),
            "noise": noise if several else noise[0],
            "robot": from_mapping(RobotConfig, self.robot),
            "laser": from_mapping(LaserConfig, self.laser),
            "closure": from_mapping(ClosureConfig, self.closure),
            "coverage": from_mapping(CoverageConfig, self.coverage),
            "reward": from_mapping(RewardConfig, self.reward),
        }
        for name, value in checked.items():
            object.__setattr__(self, name, value)

    @property
    def sensor_noise(self) -> tuple[NoiseConfig, ...]:
        """The errors in `noise`, with the presets looked up; every reset draws one of them."""
        return tuple(noise_from_name(one) for one in (self.noise if isinstance(self.noise, tuple) else (self.noise,)))

    @property
    def noise_name(self) -> str:
        """The name of the noise preset, or ``"custom"``; several are joined by a plus sign."""
        names = {preset: name for name, preset in NOISE_PRESETS.items()}
        return "+".join(names.get(one, "custom") for one in self.sensor_noise)
