"""The figures of a comparison: performance profiles, coverage over path, and the map of difficulty."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np

mpl.use("Agg")

from matplotlib import pyplot as plt

from agents import agent_label
from cyclic_env.atomic_write import atomic_write
from cyclic_env.evaluation.statistics import performance_profile, wilson_interval
from cyclic_env.floor_plans.generator.names import building_spec
from cyclic_env.tiers import TIERS
from scripts.comparison.measures import CURVE_TOURS
from scripts.comparison.table import Runs

RETURNS = np.linspace(-20, 100, 121)
ALIASING_BINS = np.array([0.0, 0.25, 0.5, 0.75, 1.0])
STYLES = ("-", "--", "-.", ":")
plt.rcParams.update({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "svg.fonttype": "none"})


def draw_figures(frame: Runs, agents: Sequence[str], folder: Path) -> list[str]:
    """Draw all figures into ``figures`` in a folder, as SVG, and return their names."""
    shown = [agent for agent in agents if (frame["agent"] == agent).any()]
    drawn = {"profiles": draw_profiles(frame, shown), "coverage": draw_coverage(frame, shown)}
    if with_aliasing(frame)["aliasing"].notna().any():
        drawn["difficulty"] = draw_difficulty(frame, shown)
    (folder / "figures").mkdir(parents=True, exist_ok=True)
    for name, figure in drawn.items():
        with atomic_write(folder / "figures" / f"{name}.svg") as path:
            figure.savefig(path, bbox_inches="tight", metadata={"Date": None})
        plt.close(figure)
    return list(drawn)


def _panels(frame: Runs, height: float = 3.0) -> tuple[Any, list[tuple[str, Any]]]:
    tiers = [tier for tier in TIERS if (frame["tier"] == tier).any()]
    figure, axes = plt.subplots(1, len(tiers), figsize=(3.4 * len(tiers) + 1, height), sharey=True, squeeze=False)
    return figure, list(zip(tiers, axes[0], strict=True))


def _style(index: int, agent: str) -> dict[str, Any]:
    """Return a label, a colour and a dash, so that agents differ in more than their colour."""
    dash = STYLES[index % len(STYLES)]
    return {"label": agent_label(agent), "color": f"C{index % 10}", "linestyle": dash, "linewidth": 1.6}


def draw_profiles(frame: Runs, agents: Sequence[str]) -> Any:
    """Draw which share of an agent's runs reaches which return, in each tier."""
    figure, panels = _panels(frame)
    for tier, axes in panels:
        for index, agent in enumerate(agents):
            runs = frame[(frame["tier"] == tier) & (frame["agent"] == agent)]
            if len(runs):
                axes.plot(RETURNS, performance_profile(runs["return"].to_numpy(), RETURNS), **_style(index, agent))
        axes.set(title=tier, xlabel="return of at least", ylim=(-0.02, 1.02), xlim=(RETURNS[0], RETURNS[-1]))
    panels[0][1].set_ylabel("share of runs")
    panels[-1][1].legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    return figure


def draw_coverage(frame: Runs, agents: Sequence[str]) -> Any:
    """Draw the mean coverage over the path driven, in closed tours, in each tier."""
    figure, panels = _panels(frame)
    for tier, axes in panels:
        for index, agent in enumerate(agents):
            runs = frame[(frame["tier"] == tier) & (frame["agent"] == agent)]
            if len(runs):
                curves = np.array([text.split() for text in runs["coverage_curve"]], float) / 1000
                axes.plot(CURVE_TOURS, curves.mean(axis=0), **_style(index, agent))
        axes.set(title=tier, xlabel="path, in closed tours", ylim=(0, 1.02), xlim=(0, 2))
        axes.axhline(0.99, color="0.7", linewidth=0.8, zorder=0)
    panels[0][1].set_ylabel("coverage, mean of runs")
    panels[-1][1].legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    return figure


def with_aliasing(frame: Runs) -> Runs:
    """Return the runs with the aliasing of the generated buildings that they are in, NaN elsewhere."""
    specs = {name: building_spec(name) for name in frame["map"].unique()}
    known = {name: np.nan if spec is None else spec.aliasing for name, spec in specs.items()}
    return frame.assign(aliasing=frame["map"].map(known).astype(float))


def difficulty(frame: Runs, agent: str) -> dict[tuple[str, int], tuple[float, float, float, int]]:
    """Return the success of an agent, with its 95 % interval and the number of runs, by tier and bin of aliasing."""
    runs = with_aliasing(frame[frame["agent"] == agent]).dropna(subset="aliasing")
    bins = np.clip(np.searchsorted(ALIASING_BINS, runs["aliasing"], side="right") - 1, 0, len(ALIASING_BINS) - 2)
    cells = {}
    for (tier, index), part in runs.groupby([runs["tier"], bins]):
        success = part["is_success"].to_numpy(bool)
        cells[str(tier), int(index)] = (float(success.mean()), *wilson_interval(success), len(success))
    return cells


def draw_difficulty(frame: Runs, agents: Sequence[str]) -> Any:
    """Draw the success of each agent over aliasing and noise, on generated buildings: where each breaks."""
    tiers = [tier for tier in TIERS if (frame["tier"] == tier).any()]
    columns = min(3, len(agents))
    rows = -(-len(agents) // columns)
    size = (3.2 * columns, (0.55 * len(tiers) + 1.1) * rows)
    figure, axes = plt.subplots(rows, columns, figsize=size, squeeze=False, layout="constrained")
    labels = [f"{low:g}-{high:g}" for low, high in pairwise(ALIASING_BINS)]
    for panel in axes.flat[len(agents) :]:
        panel.set_axis_off()
    for agent, panel in zip(agents, axes.flat, strict=False):
        cells, values = difficulty(frame, agent), np.full((len(tiers), len(labels)), np.nan)
        for (tier, index), (share, low, high, count) in cells.items():
            values[tiers.index(tier), index] = share
            text = f"{share:.2f}\n[{low:.2f}, {high:.2f}]\nn={count}"
            color = "white" if share < 0.5 else "black"
            panel.text(index, tiers.index(tier), text, ha="center", va="center", fontsize=6.5, color=color)
        panel.imshow(values, vmin=0, vmax=1, cmap="viridis", aspect="auto")
        panel.set(title=agent_label(agent), xticks=range(len(labels)), yticks=range(len(tiers)))
        panel.set_xticklabels(labels, fontsize=7)
        panel.set_yticklabels(tiers, fontsize=7)
        panel.spines[:].set_visible(False)
    figure.supxlabel("aliasing of the building", fontsize=9)
    figure.colorbar(axes[0, 0].images[0], ax=axes, label="success", shrink=0.8)
    return figure
