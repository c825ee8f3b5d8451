"""The three sensors and their errors: distance meter, compass and laser.

The noise presets and their terms are in `cyclic_env.config`. Every robot draws from its own generator, and
equally many numbers in each step, so that its random numbers depend on nothing that happens.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from cyclic_env.config import LaserConfig, NoiseConfig
from cyclic_env.jit import call_c, compiled

FIELD_WAVES = 64
"""Number of plane waves whose sum is the compass field; the more, the closer it is to a Gaussian field."""

ERRORS = np.dtype(
    [
        ("scale", "f8"),  # of the distance meter, a factor of the true distance
        ("drift", "f8"),  # of the distance meter, metres per square root of a metre driven
        ("slip_rate", "f8"),  # slips of the wheels per metre driven
        ("slip_length", "f8"),  # mean of a slip, metres
        ("white", "f8"),  # noise of the compass, radians
        ("field_amplitude", "f8"),  # of each wave of the compass field, radians
        ("laser_sigma", "f8"),
        ("laser_sigma_relative", "f8"),
        ("laser_short", "f8"),
        ("laser_max", "f8"),
        ("laser_random", "f8"),
    ]
)
"""Errors of a robot's sensors in an episode; see `NoiseConfig`."""


class Fills(NamedTuple):
    """Addresses of NumPy's C functions that fill arrays with random numbers; 0 if NumPy's library hides them.

    They draw the same numbers as the methods of a `Generator`, which call them, but calling a method takes longer than
    drawing the numbers of a scan. NumPy documents this use ("Extending", the example with CFFI).
    """

    normal: int
    uniform_f: int
    normal_f: int


def numpy_fills() -> Fills:
    """Return the addresses of NumPy's functions in this process."""
    library = ctypes.CDLL(np.random._generator.__file__)  # pyright: ignore[reportAttributeAccessIssue]
    names = ("random_standard_normal_fill", "random_standard_uniform_fill_f", "random_standard_normal_fill_f")
    functions = (getattr(library, name, None) for name in names)
    return Fills(*(ctypes.cast(function, ctypes.c_void_p).value or 0 if function else 0 for function in functions))


FILLS = numpy_fills()


class Sensors:
    """The sensors of N robots: the errors drawn for their episodes, and their readings.

    Parameters
    ----------
    noise : sequence of NoiseConfig
        If there are several, a robot draws one at each reset.
    laser : LaserConfig
    num_robots : int

    Attributes
    ----------
    true_ranges : (N, num_beams) float64
        What the laser would read without errors, metres; filled by the engine.
    ranges : (N, num_beams) float64
        What the laser reads, metres; the same array if it is exact.
    distance : (N,) float64
        Readings of the distance meters, metres.
    compass : (N, 2) float64
        Readings of the compasses: unit vectors, east and north.
    errors : (N,) array of `ERRORS`
    field : (N, waves, 3) float64
        Wave numbers east and north, and phase, of the waves of each robot's compass field.
    """

    def __init__(self, noise: Sequence[NoiseConfig], laser: LaserConfig, num_robots: int) -> None:
        self.noise = tuple(noise)
        self.laser = laser
        self._laser_is_exact = all(one.laser_is_exact for one in noise)
        self.true_ranges = np.zeros((num_robots, laser.num_beams))
        self.ranges = self.true_ranges if self._laser_is_exact else np.zeros((num_robots, laser.num_beams))
        self.distance = np.zeros(num_robots)
        self.compass = np.zeros((num_robots, 2))
        waves = FIELD_WAVES if any(one.compass_field_deg > 0 for one in noise) else 0
        self.field = np.zeros((num_robots, waves, 3))
        self.errors = np.zeros(num_robots, ERRORS)
        self._drifts = any(one.distance_drift > 0 or one.compass_white_deg > 0 for one in noise)
        self._normals = np.zeros((num_robots, 2))
        self._slips = np.zeros((num_robots, 1 if any(one.wheels_slip for one in noise) else 0), np.float32)
        drawn = 0 if self._laser_is_exact else laser.num_beams
        # Single precision, like the observations, takes half the time to draw.
        self._beam_uniforms = np.zeros((num_robots, drawn), np.float32)
        self._beam_normals = np.zeros((num_robots, drawn), np.float32)

    def reset_row(self, row: int, rng: np.random.Generator) -> None:
        """Draw a robot's errors for an episode; its distance meter starts at 0."""
        self.distance[row] = 0.0
        noise = self.noise[int(rng.integers(len(self.noise))) if len(self.noise) > 1 else 0]
        self.errors[row] = (
            1.0,
            noise.distance_drift,
            noise.slip_rate,
            noise.slip_length,
            math.radians(noise.compass_white_deg),
            math.radians(noise.compass_field_deg) * math.sqrt(2 / FIELD_WAVES),
            noise.laser_sigma,
            noise.laser_sigma_relative,
            noise.laser_short,
            noise.laser_max,
            noise.laser_random,
        )
        if noise.distance_scale > 0:
            self.errors["scale"][row] += noise.distance_scale * rng.standard_normal()
        if noise.compass_field_deg > 0:
            field = self.field[row]
            field[:, :2] = rng.standard_normal((FIELD_WAVES, 2)) / noise.compass_field_length
            field[:, 2] = rng.uniform(0, 2 * math.pi, FIELD_WAVES)

    def measure_rows(self, rows: np.ndarray, drive: np.ndarray, rngs: Sequence[np.random.Generator]) -> None:
        """Take the readings of the robots `rows` after a step.

        Parameters
        ----------
        rows : (n,) int64
        drive : (N,) structured array
            With `x`, `y`, `angle`, and `travel`: the signed displacement along the heading in this step, metres.
        rngs : sequence of N Generators
        """
        self._draw(rows, rngs)
        read_rows(rows, drive, self.errors, self.field, self._normals, self.distance, self.compass)
        if self._slips.size:
            slip_rows(rows, drive, self.errors, self._slips, self.distance)
        if self._laser_is_exact:
            return
        disturb_rows(
            rows,
            self.true_ranges,
            self.errors,
            self._beam_uniforms,
            self._beam_normals,
            float(self.laser.range_max),
            self.ranges,
        )

    def _draw(self, rows: np.ndarray, rngs: Sequence[np.random.Generator]) -> None:
        """Draw the random numbers of a step, from each robot's own generator."""
        if not self._drifts and self._laser_is_exact and not self._slips.size:
            return
        if all(FILLS):
            generators = [rngs[row].bit_generator.ctypes.bit_generator.value for row in rows.tolist()]
            arrays = self._normals, self._slips, self._beam_uniforms, self._beam_normals
            draw_rows(rows, np.array(generators, np.int64), FILLS, self._drifts, *arrays)
            return
        for row in rows:
            if self._drifts:
                rngs[row].standard_normal(out=self._normals[row])
            rngs[row].random(dtype=np.float32, out=self._slips[row])
            rngs[row].random(dtype=np.float32, out=self._beam_uniforms[row])
            rngs[row].standard_normal(dtype=np.float32, out=self._beam_normals[row])

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        if self._laser_is_exact:
            self.ranges = self.true_ranges


@compiled
def draw_rows(rows, generators, fills, drifts, normals, slips, beam_uniforms, beam_normals):
    """Fill `rows` of the arrays with random numbers, and `normals` only if a meter or compass `drifts`.

    `generators` holds the addresses of these robots' generators.
    """
    for i in range(rows.shape[0]):
        row, generator = rows[i], generators[i]
        if drifts:
            call_c(fills.normal, (generator, normals.shape[1], normals[row].ctypes.data))
        call_c(fills.uniform_f, (generator, slips.shape[1], slips[row].ctypes.data))
        call_c(fills.uniform_f, (generator, beam_uniforms.shape[1], beam_uniforms[row].ctypes.data))
        call_c(fills.normal_f, (generator, beam_normals.shape[1], beam_normals[row].ctypes.data))


@compiled
def field_at(waves, amplitude, x, y):
    """Return the compass's deflection at (x, y) in radians: a sum of plane waves `waves` (n, 3), 0 for none."""
    total = 0.0
    for i in range(waves.shape[0]):
        total += math.cos(waves[i, 0] * x + waves[i, 1] * y + waves[i, 2])
    return amplitude * total


@compiled
def read_rows(rows, drive, errors, field, normals, distance, compass):
    """Add the last step to the distance meters, and read the compasses, of the robots `rows`."""
    for row in rows:
        robot, noise = drive[row], errors[row]
        distance[row] += robot.travel * noise.scale + noise.drift * math.sqrt(abs(robot.travel)) * normals[row, 0]
        deflection = field_at(field[row], noise.field_amplitude, robot.x, robot.y)
        shown = robot.angle + deflection + noise.white * normals[row, 1]
        compass[row, 0], compass[row, 1] = math.cos(shown), math.sin(shown)


@compiled
def slip_rows(rows, drive, errors, uniforms, distance):
    """Add the slips of the wheels in the last step to the distance meters of the robots `rows`.

    One uniform number of `uniforms` `(N, 1)` decides whether there is a slip and, scaled, how long it is.
    """
    for row in rows:
        noise, travel = errors[row], drive[row].travel
        probability = 1.0 - math.exp(-noise.slip_rate * abs(travel))
        u = float(uniforms[row, 0])
        if u < probability:
            distance[row] += math.copysign(-noise.slip_length * math.log(1.0 - u / probability), travel)


@compiled
def disturb_rows(rows, true_ranges, errors, uniforms, normals, range_max, ranges):
    """Write the ranges that the robots `rows` read, by the beam model, into `ranges`.

    One uniform number decides which term of the model applies to a beam and, scaled, which range it then reads.

    Parameters
    ----------
    rows : (n,) int64
    true_ranges : (N, num_beams) float64
    errors : (N,) array of `ERRORS`
    uniforms, normals : (N, num_beams) float32
    range_max : float
    ranges : (N, num_beams) float64
        Output.
    """
    for row in rows:
        noise = errors[row]
        sigma, relative = noise.laser_sigma, noise.laser_sigma_relative
        short, maximum, random = noise.laser_short, noise.laser_max, noise.laser_random
        for beam in range(true_ranges.shape[1]):
            true, u = true_ranges[row, beam], float(uniforms[row, beam])
            if u < short:
                value = true * u / short
            elif u < short + maximum:
                value = range_max
            elif u < short + maximum + random:
                value = range_max * (u - short - maximum) / random
            else:
                value = true + (sigma + relative * true) * float(normals[row, beam])
            ranges[row, beam] = min(max(value, 0.0), range_max)
