"""Train an agent of Stable-Baselines3, and write its model and settings to a folder."""

from __future__ import annotations

if __name__ == "__main__":
    from _cli import run_script

    run_script(__file__)

import argparse
import shlex
from collections.abc import Sequence
from pathlib import Path

from agents.rl import require_learning
from cyclic_env.floor_plans import separate_names
from scripts._cli import command, interruptible, progress_bar

EXAMPLE = (
    "example: python scripts/train.py --algo ppo --steps 300000 --map ring && python scripts/evaluate.py out/ppo_ring"
)


@command
def main(arguments: Sequence[str] | None) -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__, epilog=EXAMPLE)
    parser.add_argument("--algo", help="ppo, a2c, sac or td3 (default ppo)")
    parser.add_argument(
        "--steps", type=int, default=300_000, help="of all robots together, rounded up (default 300000)"
    )
    parser.add_argument("--map", dest="map_name", help="floor plan, or several with commas between (default ring)")
    parser.add_argument("--noise", help="ideal, calibrated, typical or poor (default ideal)")
    parser.add_argument("--action-type", help="wheels, twist or discrete (default wheels)")
    parser.add_argument("--step-budget", type=int, help="longest episode (default: what the plan needs)")
    parser.add_argument("--num-envs", type=int, help="robots at once (default 16)")
    parser.add_argument("--seed", type=int, help="(default 0)")
    parser.add_argument("--out", type=Path, help="folder to write to (default out/ALGO_MAP)")
    parser.add_argument("--resume", action="store_true", help="go on with the model in the folder until --steps")
    parser.add_argument("--overwrite", action="store_true", help="replace the model in the folder")
    args = parser.parse_args(arguments)
    names = ("algo", "map_name", "noise", "action_type", "step_budget", "num_envs", "seed")
    given = {name: getattr(args, name) for name in names if getattr(args, name) is not None}
    out = args.out or default_out(**given)
    require_learning()
    from agents.rl.settings import training_settings
    from agents.rl.storage import MODEL, resumed_settings, steps_done
    from agents.rl.training import train

    settings = resumed_settings(out, given) if args.resume else training_settings(given)
    with interruptible() as interruption, progress_bar(unit="step") as progress:
        train(settings, steps=args.steps, out=out, resume=args.resume, overwrite=args.overwrite, progress=progress)
    if interruption:
        raise interruption.stopped(
            f"{out / MODEL} has {steps_done(out):,} of {args.steps:,} steps. "
            f"To go on: python scripts/train.py --out {shlex.quote(str(out))} --resume --steps {args.steps}"
        )
    print(f"{out / MODEL}: {steps_done(out):,} steps. To score it: python scripts/evaluate.py {out}")


def default_out(*, algo: str = "ppo", map_name: str = "ring", **_: object) -> Path:
    """Return the folder for a model when none is named."""
    return Path("out") / f"{algo}_{'_'.join(Path(name).stem for name in separate_names(map_name))}"
