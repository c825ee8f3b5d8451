"""Draw learning curves: of each algorithm the mean over its training runs, and a band from the least to the most."""

from __future__ import annotations

if __name__ == "__main__":
    from _cli import run_script

    run_script(__file__)

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
from tyro.conf import Positional, arg

from cyclic_env.atomic_write import atomic_write, check_outputs
from cyclic_env.errors import ConfigError
from cyclic_env.rendering.colors import AMBER, PATH_NEW, RIGHT, WRONG
from scripts._cli import command

if TYPE_CHECKING:
    import pandas as pd

COLORS = (PATH_NEW, AMBER, RIGHT, WRONG)
POINTS, WINDOW = 60, 100
"""Points of a curve, and the episodes before each over which the mean is taken."""
EXAMPLE = (
    "example: python scripts/draw_curves.py MaskablePPO=agents/pretrained/ppo_headings,out/other_seed PPO=out/flat"
)


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of the command."""

    curves: Annotated[tuple[str, ...], Positional, arg(metavar="LABEL=FOLDER,FOLDER...", help_behavior_hint="")]
    """folders of training runs, the seeds of an algorithm with commas between"""
    out: Path = Path("out/curves.png")
    """file of the figure"""


@command(Options, EXAMPLE)
def main(args: Options) -> None:
    """Run the command."""
    from matplotlib.figure import Figure

    check_outputs([args.out])
    runs = dict(parse_curve(curve) for curve in args.curves)
    figure = Figure((10, 3.2), layout="constrained")
    axes = figure.subplots(1, 3)
    for (label, tables), color in zip(runs.items(), COLORS, strict=False):
        for axis, values in zip(axes, ("return", "share", "false_claims"), strict=True):
            steps, curves = smoothed(tables, values)
            shade = [channel / 255 for channel in color]
            axis.plot(steps / 1000, np.nanmean(curves, axis=0), color=shade, label=label)
            axis.fill_between(
                steps / 1000, np.nanmin(curves, axis=0), np.nanmax(curves, axis=0), color=shade, alpha=0.2, linewidth=0
            )
    for axis, title in zip(axes, ("return", "share of the cycles closed", "false claims a run"), strict=True):
        axis.set_title(title, fontsize=10)
        axis.set_xlabel("thousand decisions", fontsize=9)
        axis.grid(alpha=0.3)
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].legend(frameon=False, fontsize=9)
    with atomic_write(args.out) as part:
        figure.savefig(part, dpi=150, format=args.out.suffix.removeprefix(".") or "png")
    print(f"written: {args.out}")


def parse_curve(text: str) -> tuple[str, list[pd.DataFrame]]:
    """Return the label, and the episodes of each run."""
    import pandas as pd

    label, equals, folders = text.partition("=")
    if not equals:
        raise ConfigError(f"{text!r} names no curve; expected LABEL=FOLDER,FOLDER.")
    tables = []
    for folder in folders.split(","):
        try:
            table = pd.read_csv(Path(folder) / "progress.csv")
        except OSError as error:
            raise ConfigError(f"{folder} is no folder of a training run: {error}.") from error
        tables.append(table.assign(share=table.cycles_closed / table.cycles_total.clip(lower=1)))
    return label, tables


def smoothed(tables: list[pd.DataFrame], column: str) -> tuple[np.ndarray, np.ndarray]:
    """Return steps `(points,)`, and at each of them the mean of the latest episodes of every run `(runs, points)`.

    It is NaN after the end of a run that is shorter than others.
    """
    first = max(table.steps.iloc[min(WINDOW // 4, len(table) - 1)] for table in tables)
    steps = np.linspace(first, max(table.steps.iloc[-1] for table in tables), POINTS)
    curves = []
    for table in tables:
        ends = np.searchsorted(table.steps, steps, side="right")
        means = np.array([table[column].iloc[max(0, end - WINDOW) : end].mean() for end in ends])
        curves.append(np.where(steps <= table.steps.iloc[-1], means, np.nan))
    return steps, np.array(curves)
