"""Settings: stated once, taken by both environments, refused when they don't fit."""

from __future__ import annotations

from dataclasses import asdict, replace
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from cyclic_env import ConfigError, CyclicLoopEnv, CyclicLoopVectorEnv, EnvConfig, FloorPlan, NoiseConfig
from cyclic_env.config import NOISE_PRESETS, noise_from_name
from cyclic_env.validation import from_mapping
from tests.helpers import refused


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"noise": "tipical"}, "Did you mean 'typical'"),
        ({"noise": {"laser_sigm": 0.1}}, "Did you mean 'laser_sigma'"),
        ({"noise": {"laser_short": 0.6, "laser_max": 0.6}}, "at most 1"),
        ({"noise": {"laser_sigma": -1}}, "at least 0"),
        ({"map_name": ()}, "EnvConfig.map_name"),
        ({"action_type": "wheel"}, "Did you mean 'wheels'"),
        ({"random_start": "yes"}, "True or False"),
        ({"step_budget": 0}, "whole number from 1"),
        ({"robot": {"radius": float("nan")}}, "RobotConfig.radius is nan"),
        ({"robot": {"radius": 0.01}}, "substep"),
        ({"robot": {"wheels": 3}}, "unknown field of RobotConfig 'wheels'"),
        ({"laser": {"num_beams": 180.0}}, "whole number"),
        ({"closure": {"leave_radius": 1.0}}, "leave_radius"),
        ({"coverage": {"complete": 2}}, "at most 1"),
        ({"lasr": {}}, "Did you mean 'laser'"),
    ],
)
def test_a_setting_that_does_not_fit_is_refused_in_one_line(settings: dict[str, Any], message: str) -> None:
    with refused(message, ConfigError):
        from_mapping(EnvConfig, settings)


def test_settings_survive_a_trip_through_plain_values() -> None:
    config = EnvConfig(map_name=("ring", "grid"), noise=NoiseConfig(laser_sigma=0.1), step_budget=7)
    assert from_mapping(EnvConfig, asdict(config)) == config


def test_noise_has_the_name_of_its_preset() -> None:
    assert EnvConfig(noise="typical").sensor_noise == (NOISE_PRESETS["typical"],)
    assert EnvConfig(noise=("ideal", "poor")).noise_name == "ideal+poor"
    assert EnvConfig(noise=NOISE_PRESETS["poor"]).noise_name == "poor"
    assert EnvConfig(noise=replace(noise_from_name("poor"), laser_sigma=0.5)).noise_name == "custom"


@pytest.mark.parametrize("env_class", [CyclicLoopEnv, CyclicLoopVectorEnv])
def test_both_environments_take_a_config_and_single_fields_in_place_of_its_own(
    env_class: Any, square_room: FloorPlan
) -> None:
    config = EnvConfig(map_name="ring", noise="typical", step_budget=9)
    assert env_class(config=config).config == config
    assert env_class(config={"map_name": "ring", "noise": "typical", "step_budget": 9}).config == config
    env = env_class(map_name=[square_room, "grid"], config=config, laser={"num_beams": 90})
    assert env.config == replace(config, map_name=("square_room", "grid"), laser=replace(config.laser, num_beams=90))
    assert [plan.name for plan in env.floor_plans] == ["square_room", "grid"]


@pytest.mark.parametrize("number", [Fraction(1, 3), np.float32(0.3), np.longdouble(0.3)])
def test_numbers_of_other_types_are_stored_as_pythons(number: Any) -> None:
    config = from_mapping(EnvConfig, {"step_budget": np.int32(5), "robot": {"radius": number}})
    assert type(config.step_budget) is int
    assert config.robot.radius == float(number)
    assert type(config.robot.radius) is float
