"""The sensors' errors, checked against their definitions by statistics.

Seeds are fixed. Bounds are `SURE` standard errors of what is measured, at which a right sensor fails once in 10,000
choices of the seed, and which a few percent of error exceed.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import shapely
from scipy.stats import expon, kstest, norm

from cyclic_env import CyclicLoopEnv, CyclicLoopVectorEnv
from cyclic_env.config import NOISE_PRESETS, LaserConfig, NoiseConfig
from cyclic_env.floor_plans import FloorPlan, load_floor_plan
from cyclic_env.simulation.physics import DRIVE
from cyclic_env.simulation.sensors import FILLS, Sensors, field_at

LASER = LaserConfig(num_beams=4)
RNGS = 4000
SURE = 4.0
NOISY = ("calibrated", "typical", "poor")


def check_spread(errors: np.ndarray, sigma: float) -> None:
    """Check that independent Gaussian errors `(n,)` have a mean of 0 and that standard deviation."""
    n = len(errors)
    assert abs(errors.mean()) < SURE * sigma / math.sqrt(n)
    assert abs(errors.std() - sigma) < SURE * sigma / math.sqrt(2 * n)


def check_share(hits: np.ndarray, share: float) -> None:
    """Check that independent hits are that share of all."""
    assert abs(hits.mean() - share) < SURE * math.sqrt(share * (1 - share) / hits.size)


def check_same(errors: np.ndarray, distribution: Any) -> None:
    """Check, by Kolmogorov and Smirnov, that errors `(n,)` have that distribution, or that of other errors."""
    assert kstest(errors, distribution).pvalue > 1e-4


# The distance meter.


def driven(noise: NoiseConfig, travels: np.ndarray, robots: int = RNGS) -> np.ndarray:
    """Return the readings `(steps, robots)` of distance meters on the same way, given by its signed steps."""
    sensors = Sensors([noise], LASER, robots)
    rngs = [np.random.default_rng(seed) for seed in range(robots)]
    for row, rng in enumerate(rngs):
        sensors.reset_row(row, rng)
    drive, readings = np.zeros(robots, DRIVE), []
    for travel in travels:
        drive["travel"] = travel
        sensors.measure_rows(np.arange(robots), drive, rngs)
        readings.append(sensors.distance.copy())
    return np.array(readings)


@pytest.mark.parametrize("preset", NOISY)
def test_distance_error_has_the_scale_and_the_drift_of_its_preset(preset: str) -> None:
    noise = NOISE_PRESETS[preset]
    short, long = (driven(noise, np.full(3, length / 3))[-1] - length for length in (0.5, 200.0))
    check_spread(short, math.hypot(noise.distance_scale * 0.5, noise.distance_drift * math.sqrt(0.5)))
    check_spread(long, math.hypot(noise.distance_scale * 200, noise.distance_drift * math.sqrt(200)))
    check_same(long / long.std(), norm.cdf)


def test_the_scale_is_one_for_the_episode_and_the_drift_a_random_walk() -> None:
    scaled = driven(NoiseConfig(distance_scale=0.02), np.full(10, 1.0))
    per_metre = np.diff(scaled, axis=0)
    assert per_metre == pytest.approx(np.tile(per_metre[0], (9, 1)))
    check_spread(per_metre[0] - 1, 0.02)
    drifts = np.diff(driven(NoiseConfig(distance_drift=0.03), np.full(10, 1.0)), axis=0) - 1
    check_spread(drifts.ravel(), 0.03)
    correlation = np.corrcoef(drifts[0], drifts[1])[0, 1]
    assert abs(correlation) < SURE / math.sqrt(RNGS)


def test_a_robot_that_stands_does_not_drift_and_one_that_goes_back_does() -> None:
    assert (driven(NOISE_PRESETS["poor"], np.zeros(5)) == 0).all()
    to_and_fro = driven(NoiseConfig(distance_drift=0.05), np.array([1.0, -1.0, 1.0, -1.0]))[-1]
    check_spread(to_and_fro, 0.05 * 2)
    assert driven(NoiseConfig(distance_scale=0.05), np.array([3.0, -3.0]))[-1] == pytest.approx(np.zeros(RNGS))


def test_slips_come_at_their_rate_and_add_their_length_where_the_robot_drives() -> None:
    noise = NoiseConfig(slip_rate=0.04, slip_length=0.3)
    ahead = np.diff(driven(noise, np.full(200, 0.25)), axis=0) - 0.25
    slips = ahead[ahead > 1e-9]
    assert (ahead > -1e-9).all()
    check_share(ahead > 1e-9, 1 - math.exp(-0.04 * 0.25))
    check_same(slips, expon(scale=0.3).cdf)
    back = driven(noise, np.full(200, -0.25), 200)[-1] + 50
    assert back.mean() == pytest.approx(-50 * 0.04 * 0.3, rel=0.3)
    assert not driven(noise, np.zeros(50), 200).any()


def distance_after(dt: float, noise: NoiseConfig, robots: int) -> np.ndarray:
    """Return the distance meters' readings `(robots,)` after the same slight arc of 9 m, driven in steps of dt."""
    hall = FloorPlan("hall", shapely.box(0, 0, 30, 20), (2.0, 5.0, 0.0))
    settings: dict[str, Any] = {"robot": {"dt": dt}, "laser": {"num_beams": 4}, "noise": noise}
    envs = CyclicLoopVectorEnv(robots, hall, **settings)
    observation, _ = envs.reset(seed=round(1000 * dt))
    for _ in range(round(8 / dt)):
        observation, *_ = envs.step(np.tile([0.9, 1.0, -1.0, 0.0], (robots, 1)))
    return observation["distance"][:, 0].astype(float)


def test_the_distance_error_does_not_depend_on_the_length_of_a_step() -> None:
    noise = NOISE_PRESETS["typical"]
    by_step = {}
    for dt in (0.1, 0.2, 0.4):
        length = distance_after(dt, NOISE_PRESETS["ideal"], 1)[0]
        assert 8.5 < length < 9.5
        sigma = math.hypot(noise.distance_scale * length, noise.distance_drift * math.sqrt(length))
        by_step[dt] = (distance_after(dt, noise, 1500) - length) / sigma
        check_spread(by_step[dt], 1.0)
        check_same(by_step[dt], norm.cdf)
    check_same(by_step[0.1], by_step[0.2])
    check_same(by_step[0.1], by_step[0.4])


# The compass.


def fields(places: np.ndarray, noise: NoiseConfig, robots: int = RNGS) -> np.ndarray:
    """Return the fields `(robots, places)`, degrees, that sensors have drawn for an episode."""
    sensors = Sensors([noise], LASER, robots)
    for row in range(robots):
        sensors.reset_row(row, np.random.default_rng(row))
    amplitude = sensors.errors["field_amplitude"][0]
    values = [[field_at(waves, amplitude, x, y) for x, y in places] for waves in sensors.field]
    return np.degrees(values)


@pytest.mark.parametrize("preset", NOISY)
def test_the_compass_field_has_its_strength_correlation_and_no_bias(preset: str) -> None:
    noise = NOISE_PRESETS[preset]
    places = np.array([[0.0, 0.0], [5.0, 0.0], [0.0, 10.0], [-20.0, 0.0], [40.0, 0.0], [800.0, -300.0]])
    values = fields(places, noise) / noise.compass_field_deg
    for column in values.T:
        check_spread(column, 1.0)
        check_same(column, norm.cdf)
    expected = np.exp(-0.5 * (np.hypot(*places.T) / 10.0) ** 2)  # squared-exponential, 10 m
    correlation = np.atleast_2d(np.corrcoef(values.T))[0]
    assert (np.abs(correlation - expected) < SURE * (1 - expected**2) / math.sqrt(RNGS) + 1e-9).all()


def test_the_correlation_is_the_same_in_all_directions() -> None:
    angles = np.linspace(0, np.pi, 7)[:-1]
    places = np.concatenate([np.zeros((1, 2)), 10 * np.stack([np.cos(angles), np.sin(angles)], axis=1)])
    correlation = np.atleast_2d(np.corrcoef(fields(places, NoiseConfig(compass_field_deg=5)).T))[0, 1:]
    assert (np.abs(correlation - math.exp(-0.5)) < SURE * (1 - math.exp(-1)) / math.sqrt(RNGS)).all()


def test_the_field_peaks_as_often_as_a_gaussian_field_does() -> None:
    """Rice: a field of that correlation rises through u standard deviations exp(-u^2 / 2) / (2 pi 10) times a metre."""
    length, robots = 400.0, 400
    places = np.column_stack([np.arange(0, length, 0.5), np.zeros(800)])
    values = fields(places, NOISE_PRESETS["poor"], robots) / 13.0
    for level in (0.0, 1.0, 2.0, 3.0):
        rises = ((values[:, :-1] < level) & (values[:, 1:] >= level)).sum(axis=1)
        expected = length * math.exp(-0.5 * level**2) / (2 * math.pi * 10)
        assert abs(rises.mean() - expected) < SURE * max(rises.std(), 0.05) / math.sqrt(robots)


def test_poor_compasses_have_peaks_of_30_to_50_degrees_in_killian_court() -> None:
    west, south, east, north = load_floor_plan("killian_court").bounds
    x, y = np.meshgrid(np.arange(west, east, 4.0), np.arange(south, north, 4.0))
    inside = load_floor_plan("killian_court").free_space
    places = np.column_stack([x.ravel(), y.ravel()])
    places = places[shapely.contains_xy(inside, places)]
    peaks = np.abs(fields(places, NOISE_PRESETS["poor"], 100)).max(axis=1)
    assert 30 < np.median(peaks) < 40
    assert 40 < np.quantile(peaks, 0.97) < 50  # "to 45 degrees": what one building in some thirty has


@pytest.mark.parametrize("preset", NOISY)
def test_the_compass_errs_by_field_and_white_noise(preset: str, square_room: FloorPlan) -> None:
    noise = NOISE_PRESETS[preset]
    robots = 2000
    envs = CyclicLoopVectorEnv(robots, square_room, noise=noise, laser={"num_beams": 4})
    readings = []
    for _ in range(2):
        observation, *_ = envs.step(np.zeros((robots, 4))) if readings else envs.reset(seed=0)
        compass = observation["compass"]
        assert np.hypot(*compass.T) == pytest.approx(np.ones(robots), abs=1e-6)
        readings.append(np.degrees(np.arctan2(compass[:, 1], compass[:, 0])))
    check_spread(readings[0], math.hypot(noise.compass_white_deg, noise.compass_field_deg))
    between = readings[1] - readings[0]  # the field cancels: it is fixed to the building
    if noise.compass_white_deg:
        check_spread(between, math.sqrt(2) * noise.compass_white_deg)
        check_same(between / between.std(), norm.cdf)
    else:
        assert np.abs(between).max() < 1e-4


def test_the_compass_field_is_fixed_to_the_building_and_new_in_the_next_episode() -> None:
    env = CyclicLoopEnv("ring", noise=NoiseConfig(compass_field_deg=10))
    first, _ = env.reset(seed=0)
    for wheels in [[1.0, 1.0]] * 10 + [[-1.0, -1.0]] * 10:
        env.step([*wheels, -1.0, 0.0])
    back, *_, info = env.step([0.0, 0.0, -1.0, 0.0])
    assert abs(info["x"] - env.trajectory()[0, 0]) < 0.5
    assert back["compass"] == pytest.approx(first["compass"], abs=0.02)
    second, _ = env.reset()
    assert np.abs(second["compass"] - first["compass"]).max() > 0.02


# The laser.


def readings_of(noise: NoiseConfig, true: np.ndarray, robots: int) -> np.ndarray:
    """Return readings `(robots, beams)` of the same true ranges `(beams,)`."""
    sensors = Sensors([noise], LaserConfig(num_beams=len(true)), robots)
    sensors.true_ranges[:] = true
    rngs = [np.random.default_rng(seed) for seed in range(robots)]
    for row, rng in enumerate(rngs):
        sensors.reset_row(row, rng)
    sensors.measure_rows(np.arange(robots), np.zeros(robots, DRIVE), rngs)
    return sensors.ranges


TRUE = np.linspace(2.0, 9.0, 180)
"""Ranges at which noise is nowhere clipped, even by a spread of 3.5 %."""


@pytest.mark.parametrize("preset", NOISY)
def test_ranges_follow_the_beam_model(preset: str) -> None:
    noise = NOISE_PRESETS[preset]
    readings = readings_of(noise, TRUE, 2000)
    check_share(readings == 12.0, noise.laser_max)
    sigma = noise.laser_sigma + noise.laser_sigma_relative * TRUE
    low, high = TRUE - 6 * sigma, TRUE + 6 * sigma
    # Below and above the true range there is nothing but short and random ones, both of them uniform.
    below, above = readings < low, (readings > high) & (readings < 12)
    check_share(below, (noise.laser_short * low / TRUE + noise.laser_random * low / 12).mean())
    check_share(above, (noise.laser_random * (1 - high / 12)).mean())
    check_same(((readings - high) / (12 - high))[above], "uniform")
    check_same((readings / low)[below], "uniform")
    # Beside it there are hits, and those of the uniform ones that fall there.
    near = ((readings - TRUE) / sigma)[~(below | above | (readings == 12))]
    stray_below = (noise.laser_short * 6 * sigma / TRUE + noise.laser_random * 6 * sigma / 12).mean()
    stray_above = (noise.laser_random * 6 * sigma / 12).mean()
    hits = 1 - noise.laser_short - noise.laser_max - noise.laser_random
    total = hits + stray_below + stray_above

    def mixture(z: np.ndarray) -> np.ndarray:
        uniform = stray_below * np.clip(z + 6, 0, 6) / 6 + stray_above * np.clip(z, 0, 6) / 6
        return (hits * norm.cdf(z) + uniform) / total

    check_same(near, mixture)
    check_share(np.abs(readings - TRUE) < 6 * sigma, total)


def test_beams_and_robots_and_steps_err_by_themselves() -> None:
    noise = NoiseConfig(laser_sigma=0.1)
    errors = readings_of(noise, np.full(180, 4.0), 400) - 4.0
    for one, other in ((errors[:, :-1], errors[:, 1:]), (errors[:-1], errors[1:])):
        assert abs(np.corrcoef(one.ravel(), other.ravel())[0, 1]) < SURE / math.sqrt(one.size)
    env = CyclicLoopEnv("ring", noise=noise)
    scans = [env.reset(seed=0)[0]["laser"], *(env.step(np.zeros(4))[0]["laser"] for _ in range(2))]
    assert abs(np.corrcoef(scans[1] - scans[0], scans[2] - scans[1])[0, 1] + 0.5) < 0.3  # as of white noise


@pytest.mark.parametrize("preset", NOISY)
def test_ranges_are_clipped_to_what_the_laser_can_read(preset: str) -> None:
    readings = readings_of(NOISE_PRESETS[preset], np.repeat([0.0, 0.01, 11.99, 12.0], 45), 300)
    assert readings.min() == 0
    assert readings.max() == 12
    assert (readings[:, 135:] == 12).mean() > 0.4  # half of the noise at the very end is beyond it


def test_ideal_sensors_read_the_truth(square_room: FloorPlan) -> None:
    envs = CyclicLoopVectorEnv(3, square_room)
    observation, _ = envs.reset(seed=0)
    for _ in range(5):
        observation, *_ = envs.step(np.tile([1.0, 0.6, -1.0, 0.0], (3, 1)))
    drive = envs.engine.simulation.drive
    assert (observation["laser"] == envs.engine.episodes.true_ranges.astype(np.float32)).all()
    headings = np.stack([np.cos(drive["angle"]), np.sin(drive["angle"])], axis=1)
    assert (observation["compass"] == headings.astype(np.float32)).all()
    assert observation["distance"][0, 0] == pytest.approx(envs.engine.trajectory(0)[-1, 2], rel=0.01)


# All of them.


@pytest.mark.parametrize("preset", NOISY)
def test_a_seed_gives_the_same_readings_in_a_batch_of_any_size(preset: str) -> None:
    def readings(seeds: list[int], row: int) -> list[np.ndarray]:
        envs = CyclicLoopVectorEnv(len(seeds), "ring", noise=preset)
        observation, _ = envs.reset(seed=seeds)
        scans = [observation]
        scans += [envs.step(np.tile([0.5, 0.4, -1.0, 0.0], (len(seeds), 1)))[0] for _ in range(5)]
        return [scan[name][row] for scan in scans for name in ("laser", "distance", "compass")]

    alone, among, other = readings([7], 0), readings([3, 9, 7, 1], 2), readings([8], 0)
    assert all((one == two).all() for one, two in zip(alone, among, strict=True))
    assert not all((one == two).all() for one, two in zip(alone, other, strict=True))


@pytest.mark.parametrize(
    "noise",
    [
        *("calibrated", "poor", "hard"),
        NoiseConfig(laser_sigma=0.1),
        NoiseConfig(compass_white_deg=1),
        NoiseConfig(slip_rate=1, slip_length=1),
    ],
)
def test_numbers_are_those_that_the_generators_own_methods_draw(noise: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    runs = []
    for fills in (FILLS, FILLS._replace(normal_f=0)):  # as where NumPy's library hides a function
        monkeypatch.setattr("cyclic_env.simulation.sensors.FILLS", fills)
        env = CyclicLoopVectorEnv(3, "ring", noise=noise)
        env.reset(seed=0)
        steps = [env.step(np.full((3, 4), 0.5))[0] for _ in range(20)]
        runs.append({name: [step[name].tobytes() for step in steps] for name in steps[0]})
        runs[-1]["next"] = [rng.bit_generator.state for rng in env.np_random]
    assert all(FILLS)
    assert runs[0] == runs[1]


# Several presets.


def test_of_several_presets_every_reset_draws_one_for_each_robot() -> None:
    """Ideal sensors read the true ranges, poor ones do not; both come about as often."""
    env = CyclicLoopVectorEnv(40, "ring", noise=["ideal", "poor"])
    env.reset(seed=0)
    exact = (env.engine.sensors.ranges == env.engine.sensors.true_ranges).all(axis=1)
    assert 10 < exact.sum() < 30
    env.reset()
    assert (exact != (env.engine.sensors.ranges == env.engine.sensors.true_ranges).all(axis=1)).any()
    env.close()


def test_a_list_of_one_preset_is_that_preset_to_the_bit() -> None:
    scans = []
    for noise in ("typical", ["typical"]):
        env = CyclicLoopVectorEnv(2, "ring", noise=noise)
        env.reset(seed=3)
        scans.append([env.step(np.full((2, 4), 0.5, np.float32))[0]["laser"] for _ in range(5)])
        env.close()
    np.testing.assert_array_equal(*scans)
