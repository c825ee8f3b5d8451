"""The shipped models are small, say how they came to be, and score what they did when they were shipped."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from agents import make_agent
from agents.registry import PRETRAINED
from agents.rl.storage import BEST, PROGRESS, SETTINGS, VALIDATION, load_trained
from cyclic_env.evaluation.rollout import evaluate
from cyclic_env.floor_plans import load_floor_plans

MODELS = ("ppo_headings", "ppo_headings_1", "ppo_headings_2")
SIZE_MAX = 500_000


@pytest.mark.parametrize(("seed", "name"), list(enumerate(MODELS)))
def test_a_shipped_model_is_small_and_has_its_settings_and_curves_beside_it(seed: int, name: str) -> None:
    folder: Path = PRETRAINED / name
    assert (folder / BEST).stat().st_size < SIZE_MAX
    settings = load_trained(folder).settings
    assert settings is not None
    assert (settings.seed, settings.map_name, settings.task) == (seed, ("generated:train",), "headings")
    assert settings.noise == ("calibrated", "typical", "poor")
    assert settings.validation_map == ("generated:validation",)
    assert json.loads((folder / SETTINGS).read_text())["hyperparameters"] == dict(settings.hyperparameters)
    assert all((folder / curve).read_text().startswith("steps,") for curve in (PROGRESS, VALIDATION))


@pytest.mark.parametrize("name", MODELS)
def test_a_shipped_model_drives_and_claims_by_any_kind_of_action(name: str) -> None:
    agent = make_agent(name, action_type="wheels")
    result = evaluate(agent, map_name="ring", noise="calibrated", seeds=range(2))
    assert sum(record["cycles_closed"] for record in result.episodes) == 2
    assert sum(record["false_claims"] for record in result.episodes) <= 1


@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
def test_shipped_models_keep_their_scores_on_eight_validation_plans(name: str) -> None:
    """A minute each on one core: when matching or mapping changes, the features do, and models may not bear it."""
    pool = load_floor_plans("generated:validation")[:8]
    result = evaluate(
        make_agent(name, action_type="twist"),
        map_name=pool,
        noise="calibrated",
        seeds=range(8),
        every_plan=True,
        action_type="twist",
    )
    closed, total, false = (
        sum(record[key] for record in result.episodes) for key in ("cycles_closed", "cycles_total", "false_claims")
    )
    assert closed >= 0.8 * total
    assert false <= 8
