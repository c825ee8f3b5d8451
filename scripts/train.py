"""Train an agent of Stable-Baselines3, and write its model and settings to a folder."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # agents are not installed, but run from the checkout
if __name__ == "__main__":  # Ctrl-C while the packages load
    signal.signal(signal.SIGINT, lambda *_: (print("\ntrain.py: nothing done yet", file=sys.stderr), os._exit(130)))

import argparse
import shlex
from collections.abc import Sequence

from agents.comparison import require_learning
from cyclic_env.console import say
from cyclic_env.errors import CyclicLoopError
from cyclic_env.floor_plans import separate_names

EXAMPLE = (
    "example: python scripts/train.py --algo ppo --steps 300000 --map ring && python scripts/evaluate.py out/ppo_ring"
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code: 0, 2 for bad input, 130 after Ctrl-C."""
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
    try:
        require_learning()
        from agents.rl.training import MODEL, resumed_settings, train, training_settings

        settings = resumed_settings(out, given) if args.resume else training_settings(given)
        model, complete = train(settings, steps=args.steps, out=out, resume=args.resume, overwrite=args.overwrite)
    except (CyclicLoopError, OSError, MemoryError) as error:
        print(f"train.py: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:  # before the first step, or again while the model was being saved
        print(f"train.py: stopped; {out} holds what was saved before, if anything.", file=sys.stderr)
        return 130
    if not complete:
        print(
            f"train.py: stopped after {model.num_timesteps:,} of {args.steps:,} steps; {out / MODEL} has them. "
            f"To go on: python scripts/train.py --out {shlex.quote(str(out))} --resume --steps {args.steps}",
            file=sys.stderr,
        )
        return 130
    say(f"{out / MODEL}: {model.num_timesteps:,} steps. To score it: python scripts/evaluate.py {out}")
    return 0


def default_out(*, algo: str = "ppo", map_name: str = "ring", **_: object) -> Path:
    """Return the folder for a model when none is named."""
    return Path("out") / f"{algo}_{'_'.join(Path(name).stem for name in separate_names(map_name))}"


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.exit(main())
