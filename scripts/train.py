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

EXAMPLE = """examples: python scripts/train.py --task headings --steps 500000
python scripts/train.py --algo ppo --steps 300000 --map ring && python scripts/evaluate.py out/ppo_ring"""


@command
def main(arguments: Sequence[str] | None) -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__, epilog=EXAMPLE)
    parser.add_argument("--task", help="cyclic_loop or headings (default cyclic_loop)")
    parser.add_argument("--algo", help="ppo, maskable_ppo, a2c, sac or td3 (default ppo; headings: maskable_ppo)")
    parser.add_argument(
        "--steps", type=int, default=300_000, help="of all robots together, rounded up (default 300000)"
    )
    parser.add_argument(
        "--map",
        dest="map_name",
        help="floor plan, or several with commas between (default ring; headings: generated:train)",
    )
    parser.add_argument(
        "--noise",
        help="ideal, calibrated, typical or poor, or several with commas between, of which each reset draws one "
        "(default ideal; headings: all but ideal)",
    )
    parser.add_argument("--action-type", help="wheels, twist or discrete (default wheels)")
    parser.add_argument("--step-budget", type=int, help="longest episode (default: what the plan needs)")
    parser.add_argument("--num-envs", type=int, help="robots at once (default: as the hyperparameters say)")
    parser.add_argument("--hyperparameters", metavar="YAML", help="(default: those shipped for task and algorithm)")
    parser.add_argument(
        "--validation-map",
        help="plans on which checkpoints are scored and the best one is chosen (default: generated:validation for "
        "models trained on generated:train)",
    )
    parser.add_argument("--seed", type=int, help="(default 0)")
    parser.add_argument("--out", type=Path, help="folder to write to (default out/ALGO_MAP)")
    parser.add_argument("--resume", action="store_true", help="go on with the model in the folder until --steps")
    parser.add_argument("--overwrite", action="store_true", help="replace the model in the folder")
    args = parser.parse_args(arguments)
    names = ("task", "algo", "map_name", "noise", "action_type", "step_budget", "num_envs", "seed")
    names += ("hyperparameters", "validation_map")
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


def default_out(*, task: str = "cyclic_loop", algo: str = "", map_name: str = "", **_: object) -> Path:
    """Return the folder for a model when none is named."""
    headings = task == "headings"
    algo = algo or ("maskable_ppo" if headings else "ppo")
    map_name = map_name or ("generated:train" if headings else "ring")
    maps = "_".join(Path(name).stem for name in separate_names(map_name))
    return Path("out") / f"{'headings_' if headings else ''}{algo}_{maps}"
