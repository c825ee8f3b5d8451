"""Train an agent of Stable-Baselines3, and write its model and settings to a folder."""

from __future__ import annotations

if __name__ == "__main__":
    from _cli import run_script

    run_script(__file__)

import shlex
from dataclasses import dataclass, field
from pathlib import Path

from agents.rl import require_learning
from cyclic_env.floor_plans import separate_names
from scripts._arguments import EnvArguments, EnvOptions, Flag, OptionalFile, OptionalFolder, OptionalInt, OptionalText
from scripts._cli import command, interruptible, progress_bar

EXAMPLE = """examples:
  python scripts/train.py --task headings --steps 500000
  python scripts/train.py --algo ppo --steps 300000 --map ring && python scripts/evaluate.py out/ppo_ring"""


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of the command."""

    task: OptionalText = None
    """cyclic_loop or headings (default: cyclic_loop)"""
    algo: OptionalText = None
    """ppo, maskable_ppo, a2c, sac or td3 (default: ppo; headings: maskable_ppo)"""
    steps: int = 300_000
    """number of steps of all robots together, rounded up to whole updates"""
    map: OptionalText = None
    """floor plan, or several with commas between (default: ring; headings: generated:train)"""
    noise: OptionalText = None
    """ideal, calibrated, typical, poor or hard, or several with commas between, of which each reset draws one (default:
    ideal; headings: all but ideal)"""
    action_type: OptionalText = None
    """wheels, twist or discrete (default: wheels)"""
    num_envs: OptionalInt = None
    """number of robots at once (default: as the hyperparameters say)"""
    hyperparameters: OptionalFile = None
    """YAML file (default: the one that is shipped for task and algorithm)"""
    validation_map: OptionalText = None
    """plans on which checkpoints are scored and the best one is chosen (default: generated:validation for models
    trained on generated:train)"""
    seed: OptionalInt = None
    """seed of the weights and of the environment (default: 0)"""
    out: OptionalFolder = None
    """folder to write to (default: out/ALGO_MAP)"""
    resume: Flag = False
    """continue the training of the model in the folder until --steps"""
    overwrite: Flag = False
    """replace the model in the folder"""
    env: EnvOptions = field(default_factory=EnvArguments)


@command(Options, EXAMPLE)
def main(args: Options) -> None:
    """Run the command."""
    names = ("task", "algo", "noise", "action_type", "num_envs", "seed", "hyperparameters", "validation_map")
    given = {name: getattr(args, name) for name in names} | {"map_name": args.map}
    given = {name: value for name, value in given.items() if value is not None} | args.env.changed()
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
