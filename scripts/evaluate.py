"""Score agents side by side: those that are shipped by name, others by the file or folder of their model."""

from __future__ import annotations

if __name__ == "__main__":
    from _cli import run_script

    run_script(__file__)

import json
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from agents import agent_names, baseline_names
from agents.comparison import compare
from cyclic_env import EnvConfig, __version__, map_names
from cyclic_env.atomic_write import check_writable, write_text_atomically
from cyclic_env.errors import ConfigError
from cyclic_env.evaluation.statistics import Evaluation
from cyclic_env.floor_plans import separate_names
from scripts._arguments import EnvArguments, EnvOptions, Flag, OptionalFile, OptionalInt, OptionalText, noise_presets
from scripts._cli import command, interruptible, progress_bar
from scripts._tables import format_table, table_notes

EXAMPLES = """agents by name: {names}

examples:
  python scripts/evaluate.py knn knn_paper circling --map ring
  python scripts/evaluate.py out/ppo_ring random --noise typical --episodes 20 --json out/scores.json
  python scripts/evaluate.py --all-baselines --markdown
  python scripts/evaluate.py ppo_headings knn --noise calibrated,typical,poor --every-noise
  python scripts/evaluate.py knn --map generated:test --every-plan --episodes 200 --noise typical

All agents see the same episodes: episode i has seed i. With ideal sensors and a fixed start, seeds change nothing for
agents that draw no random numbers; give --noise or --random-start."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of the command."""

    agents: Annotated[tuple[str, ...], Positional, arg(metavar="[MODEL_OR_NAME ...]", help_behavior_hint="")] = ()
    """zip or folder of a model, or agent by name"""
    all_baselines: Flag = False
    """all agents that follow a fixed rule, on all shipped plans"""
    map: OptionalText = None
    """floor plan, or several with commas between (default: the model's, or killian_court)"""
    noise: str = "ideal"
    """ideal, calibrated, typical, poor or hard, or several with commas between, of which each reset draws one"""
    every_noise: Flag = False
    """score each preset of --noise by itself"""
    action_type: OptionalText = None
    """wheels, twist or discrete (default: the model's; twist for agents of the task headings, wheels for others)"""
    episodes: OptionalInt = None
    """number of episodes, with seeds 0, 1, 2 ... (default: 10)"""
    seeds: OptionalText = None
    """A:B for the seeds from A to B - 1, in place of --episodes"""
    every_plan: Flag = False
    """run seed s on plan s of a pool, in turn (default: draw the plans)"""
    num_envs: OptionalInt = None
    """greatest number of episodes at once (default: 16)"""
    stochastic: Flag = False
    """let models draw their actions"""
    json: OptionalFile = None
    """write all episodes and the summary to a file"""
    markdown: Flag = False
    """print the tables for a document"""
    env: EnvOptions = field(default_factory=EnvArguments)


@command(Options, EXAMPLES.format(names=", ".join(agent_names())))
def main(args: Options) -> None:
    """Run the command."""
    evaluations: list[Evaluation] = []
    steps = 0

    def on_step(evaluation: Evaluation) -> None:
        nonlocal steps
        if not evaluations or evaluation is not evaluations[-1]:
            evaluations.append(evaluation)
            steps = 0
            progress.reset(total=len(evaluation.seeds))
            progress.set_description(f"{evaluation.agent} on {evaluation.map}", refresh=False)
        steps += 1
        progress.set_postfix_str(f"{steps} steps", refresh=False)
        progress.update(len(evaluation.episodes) - progress.n)

    try:
        with interruptible() as interruption, progress_bar(unit="episode") as progress:
            for _ in chosen_evaluations(args, on_step):
                if args.json:
                    write_json(evaluations, args.json)
    finally:  # episodes that have ended are shown even if an error stops the others
        count = sum(len(evaluation.episodes) for evaluation in evaluations)
        if count:
            print(tables(evaluations, markdown=args.markdown))
    if interruption and not count:
        raise interruption.stopped("no episode had ended, so there is nothing to keep.")
    if interruption:
        if args.json:
            write_json(evaluations, args.json)
        kept = f" and in {args.json}" if args.json else ""
        raise interruption.stopped(f"the {count} episodes that had ended are above{kept}.")


def chosen_evaluations(args: Options, on_step: Callable[[Evaluation], None]) -> Iterator[Evaluation]:
    """Yield the evaluations that the command line asks for, as they end.

    Raises
    ------
    CyclicLoopError
        If the command line asks for what isn't possible.
    """
    if bool(args.agents) == args.all_baselines:
        raise ConfigError("name at least one agent, or give --all-baselines alone; --help lists the names.")
    if args.json:
        check_writable(args.json)
    presets = noise_presets(args.noise)
    EnvConfig(noise=presets)  # a wrong name is said before the first episode
    every = args.every_noise and isinstance(presets, tuple)
    for noise in presets if every else [presets]:
        yield from compare(
            baseline_names() if args.all_baselines else args.agents,
            maps=separate_names(args.map) if args.map is not None else map_names() if args.all_baselines else (),
            action_type=args.action_type,
            seeds=parse_seeds(args.seeds, args.episodes),
            num_envs=args.num_envs,
            every_plan=args.every_plan,
            deterministic=not args.stochastic,
            on_step=on_step,
            settings={"noise": noise, **args.env.settings()},
        )


def parse_seeds(seeds: str | None, episodes: int | None) -> range:
    """Return the seeds that ``A:B`` or a number of episodes stands for.

    Raises
    ------
    ConfigError
        If both are given, or the text is not of this form.
    """
    if seeds is None:
        return range(10 if episodes is None else episodes)
    if episodes is not None:
        raise ConfigError("give --seeds or --episodes, not both.")
    ends = re.fullmatch(r"(\d{1,18}):(\d{1,18})", seeds)
    if not ends:
        raise ConfigError(f"--seeds is {seeds!r}; expected A:B, two whole numbers of at least 0.")
    return range(int(ends[1]), int(ends[2]))


def write_json(evaluations: Sequence[Evaluation], path: Path) -> None:
    """Write the evaluations to a file."""
    entries = {"cyclic_env": __version__, "evaluations": [evaluation.to_json() for evaluation in evaluations]}
    write_text_atomically(path, json.dumps(entries, indent=1) + "\n")


def tables(evaluations: Sequence[Evaluation], *, markdown: bool) -> str:
    """Return a table and its notes; in a document, each of several maps gets a table under its name."""
    notes = "\n".join(table_notes(evaluations))
    if not markdown or len({evaluation.map for evaluation in evaluations}) == 1:
        return f"{format_table(evaluations, markdown=markdown)}\n\n{notes}"
    shared = ["map", "start"] + ["noise"] * (len({evaluation.noise for evaluation in evaluations}) == 1)
    parts = [
        f"### {name}\n\n{format_table([one for one in evaluations if one.map == name], markdown=True, without=shared)}"
        for name in dict.fromkeys(evaluation.map for evaluation in evaluations)
    ]
    return "\n\n".join([*parts, notes])
