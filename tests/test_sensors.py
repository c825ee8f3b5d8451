"""The sensors' errors, checked against their definitions by statistics."""

from __future__ import annotations

import numpy as np
import pytest

from cyclic_env import CyclicLoopEnv, CyclicLoopVectorEnv
from cyclic_env.config import NOISE_PRESETS, LaserConfig, NoiseConfig
from cyclic_env.floor_plans import FloorPlan
from cyclic_env.sensors import field_at
from cyclic_env.simulation import DRIVE

LASER = LaserConfig(num_beams=4)
RNGS = 4000


def drift_after(length: float, steps: int, noise: NoiseConfig) -> np.ndarray:
    """Return the distance meters' errors `(RNGS,)` after `length` metres driven in that many steps."""
    from cyclic_env.sensors import Sensors

    sensors = Sensors(noise, LASER, RNGS)
    rngs = [np.random.default_rng(seed) for seed in range(RNGS)]
    for row, rng in enumerate(rngs):
        sensors.reset_row(row, rng)
    drive = np.zeros(RNGS, DRIVE)
    drive["travel"] = length / steps
    for _ in range(steps):
        sensors.measure_rows(np.arange(RNGS), drive, rngs)
    return sensors.distance - length


@pytest.mark.parametrize("preset", ["calibrated", "typical", "poor"])
def test_distance_error_has_the_scale_and_the_drift_of_its_preset(preset: str) -> None:
    noise = NOISE_PRESETS[preset]
    length = 9.0
    expected = np.hypot(noise.distance_scale * length, noise.distance_drift * np.sqrt(length))
    errors = drift_after(length, 5, noise)
    assert errors.std() == pytest.approx(expected, rel=0.06)
    assert abs(errors.mean()) < 4 * expected / np.sqrt(RNGS)


@pytest.mark.parametrize("steps", [1, 4, 16])
def test_drift_does_not_depend_on_the_length_of_a_step(steps: int) -> None:
    errors = drift_after(4.0, steps, NoiseConfig(distance_drift=0.05))
    assert errors.std() == pytest.approx(0.05 * 2.0, rel=0.06)


def test_the_compass_field_has_its_strength_correlation_and_no_bias() -> None:
    rng = np.random.default_rng(0)
    places = np.array([[0.0, 0.0], [5.0, 0.0], [0.0, 10.0], [40.0, 0.0]])
    fields = np.zeros((RNGS, 4))
    for field in fields:
        waves = np.column_stack([rng.standard_normal((64, 2)) / 10.0, rng.uniform(0, 2 * np.pi, 64)])
        field[:] = [field_at(waves, np.sqrt(2 / 64), x, y) for x, y in places]
    covariance = np.cov(fields.T)
    assert np.diag(covariance) == pytest.approx(np.ones(4), abs=0.1)
    assert covariance[0, 1:] == pytest.approx(np.exp(-0.5 * np.array([0.5, 1.0, 4.0]) ** 2), abs=0.08)
    assert fields.mean(axis=0) == pytest.approx(np.zeros(4), abs=0.08)


@pytest.mark.parametrize("preset", ["calibrated", "typical", "poor"])
def test_the_compass_errs_by_field_and_white_noise(preset: str, square_room: FloorPlan) -> None:
    noise = NOISE_PRESETS[preset]
    env = CyclicLoopVectorEnv(2000, square_room, noise=noise, laser={"num_beams": 4})
    observation, _ = env.reset(seed=0)
    errors = np.degrees(np.arctan2(observation["compass"][:, 1], observation["compass"][:, 0]))
    expected = np.hypot(noise.compass_white_deg, noise.compass_field_deg)
    assert errors.std() == pytest.approx(expected, rel=0.08)
    assert abs(errors.mean()) < 5 * expected / np.sqrt(2000)


def test_the_compass_field_is_fixed_to_the_building() -> None:
    env = CyclicLoopEnv("ring", noise=NoiseConfig(compass_field_deg=10))
    env.reset(seed=0)
    readings = [env.step(np.zeros(4))[0]["compass"] for _ in range(3)]
    assert (readings[0] == readings[2]).all()


def laser_readings(preset: str, plan: FloorPlan) -> tuple[np.ndarray, np.ndarray]:
    """Return many readings `(n, beams)` of one scan, and the true ranges `(beams,)`."""
    env = CyclicLoopVectorEnv(3000, plan, noise=preset, laser={"num_beams": 16, "range_max": 11.0})
    observation, _ = env.reset(seed=0)
    return observation["laser"].astype(float), env.engine.episodes.true_ranges[0]


@pytest.mark.parametrize("preset", ["calibrated", "typical", "poor"])
def test_ranges_follow_the_beam_model(preset: str, square_room: FloorPlan) -> None:
    noise = NOISE_PRESETS[preset]
    readings, true = laser_readings(preset, square_room)
    sigma = noise.laser_sigma + noise.laser_sigma_relative * true
    hits = np.abs(readings - true) < 5 * sigma
    share = 1 - noise.laser_short - noise.laser_max - noise.laser_random
    assert hits.mean() == pytest.approx(share, abs=0.02)
    errors = np.where(hits, readings - true, np.nan)
    # Random and short ranges that fall beside the true one widen the spread a little.
    assert np.nanstd(errors, axis=0) == pytest.approx(sigma, rel=0.12)
    assert (readings == 11.0).mean() == pytest.approx(noise.laser_max, abs=0.006)
    far_short = (readings < true - 6 * sigma).mean()
    assert far_short == pytest.approx(noise.laser_short + noise.laser_random * (true / 11).mean(), rel=0.25)
    assert readings.min() >= 0
    assert readings.max() <= 11


def test_ideal_sensors_read_the_truth(square_room: FloorPlan) -> None:
    readings, true = laser_readings("ideal", square_room)
    assert (readings == true.astype(np.float32)).all()
