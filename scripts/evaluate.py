"""Score agents side by side: scripted ones by name, trained ones by the file or folder of their model."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # agents are not installed, but run from the checkout

from agents import agent_names
from agents.comparison import compare
from cyclic_env import __version__, map_names
from cyclic_env.errors import ConfigError, CyclicLoopError
from cyclic_env.evaluation import Evaluation, format_table

EXAMPLES = """agents by name: {names}

examples:
  python scripts/evaluate.py circling circling+claims --map ring
  python scripts/evaluate.py out/ppo_ring random --noise typical --episodes 20 --json out/scores.json
  python scripts/evaluate.py --all-baselines --markdown

The agents see the same episodes: episode i is that of seed i. Square brackets hold 95 % intervals of the mean."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code: 0, 2 for bad input, 130 after Ctrl-C."""
    parser = argparse.ArgumentParser(
        description=__doc__,
        epilog=EXAMPLES.format(names=", ".join(agent_names())),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("agents", nargs="*", metavar="MODEL_OR_NAME", help="zip or folder of a model, or agent by name")
    parser.add_argument("--all-baselines", action="store_true", help="all agents by name, on all shipped floor plans")
    parser.add_argument(
        "--map", help="floor plan, or several with commas between (default: the model's, or killian_court)"
    )
    parser.add_argument("--noise", default="ideal", help="ideal, calibrated, typical or poor (default ideal)")
    parser.add_argument("--action-type", help="wheels, twist or discrete (default: the model's, or wheels)")
    parser.add_argument("--episodes", type=int, help="how many, with seeds 0, 1, 2 ... (default 10)")
    parser.add_argument("--seeds", help="A:B, the seeds from A to B - 1, in place of --episodes")
    parser.add_argument("--step-budget", type=int, help="longest episode (default: what the plan needs)")
    parser.add_argument("--num-envs", type=int, help="episodes at once (default up to 16)")
    parser.add_argument("--stochastic", action="store_true", help="let models draw their actions")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all episodes and the summary to a file")
    parser.add_argument("--markdown", action="store_true", help="print the tables for a document")
    args = parser.parse_args(arguments)
    try:
        if bool(args.agents) == args.all_baselines:
            raise ConfigError("name at least one agent, or give --all-baselines alone; --help lists the names.")
        maps = args.map.split(",") if args.map else list(map_names()) if args.all_baselines else []
        seeds = parse_seeds(args.seeds, args.episodes)
        if args.json:
            open_for_writing(args.json)
        evaluations = compare(
            agent_names() if args.all_baselines else args.agents,
            maps=maps,
            noise=args.noise,
            seeds=seeds,
            action_type=args.action_type,
            step_budget=args.step_budget,
            num_envs=args.num_envs,
            deterministic=not args.stochastic,
            progress=True,
        )
        if args.json:
            write_json(evaluations, args.json)
    except CyclicLoopError as error:
        print(f"evaluate.py: {error}", file=sys.stderr)
        return 2
    print(tables(evaluations, markdown=args.markdown))
    if not all(evaluation.complete for evaluation in evaluations):
        print("Stopped early: only the episodes that had ended are counted.", file=sys.stderr)
        return 130
    return 0


def parse_seeds(seeds: str | None, episodes: int | None) -> range:
    """Return the seeds that ``A:B``, or a number of episodes, stands for.

    Raises
    ------
    ConfigError
        If it stands for none, or both are given.
    """
    if seeds is None:
        first, last = 0, 10 if episodes is None else episodes
    else:
        if episodes is not None:
            raise ConfigError("give --seeds or --episodes, not both.")
        first_text, _, last_text = seeds.partition(":")
        if not (first_text.isdecimal() and last_text.isdecimal()):
            raise ConfigError(f"--seeds is {seeds!r}; expected A:B, two whole numbers of at least 0.")
        first, last = int(first_text), int(last_text)
    if last <= first:
        raise ConfigError("there must be at least one episode.")
    return range(first, last)


def open_for_writing(path: Path) -> None:
    """Check, before hours of work, that the file can be written.

    Raises
    ------
    ConfigError
        If it can't.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.open("a").close()
    except OSError as error:
        raise ConfigError(f"can't write to {path}: {error.strerror}.") from error


def write_json(evaluations: Sequence[Evaluation], path: Path) -> None:
    """Write the evaluations to a file."""
    entries = {"cyclic_env": __version__, "evaluations": [evaluation.to_json() for evaluation in evaluations]}
    path.write_text(json.dumps(entries, indent=1) + "\n", encoding="utf-8")


def tables(evaluations: Sequence[Evaluation], *, markdown: bool) -> str:
    """Return one table; in a document with several maps, one for each, under its name."""
    if not markdown or len({evaluation.map for evaluation in evaluations}) == 1:
        return format_table(evaluations, markdown=markdown)
    return "\n\n".join(
        f"### {name}\n\n{format_table(list(group), markdown=True, without=('map', 'noise'))}"
        for name, group in groupby(evaluations, lambda evaluation: evaluation.map)
    )


if __name__ == "__main__":
    sys.exit(main())
