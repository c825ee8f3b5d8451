"""Let any agent drive a building once, by default a learned one Killian Court; write figure, animation and scores."""

from __future__ import annotations

if __name__ == "__main__":
    from _cli import run_script

    run_script(__file__)

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

from agents.comparison import load_contestant
from cyclic_env import CyclicLoopEnv, __version__
from cyclic_env.atomic_write import atomic_write, check_outputs, write_text_atomically
from scripts._arguments import EnvArguments, EnvOptions, Flag, OptionalFolder, OptionalText, noise_presets
from scripts._cli import command, interruptible, progress_bar
from scripts._tables import format_rows, score_rows

if TYPE_CHECKING:
    from cyclic_env.rendering.gif import GifWriter

FIGURE_DPI = 150


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of the command."""

    agent: Annotated[str, Positional, arg(metavar="MODEL_OR_NAME")] = "ppo_headings"
    """zip or folder of a model, or agent by name"""
    map: str = "killian_court"
    """a shipped plan, a file, or a building such as generated:seed=7"""
    noise: str = "calibrated"
    """ideal, calibrated, typical or poor, or several with commas between, of which each reset draws one"""
    action_type: OptionalText = None
    """wheels, twist or discrete (default: the agent's)"""
    seed: int = 0
    """seed of the noise and the random start"""
    out: OptionalFolder = None
    """folder for the files (default: out/AGENT)"""
    no_gif: Flag = False
    """write no animation"""
    env: EnvOptions = field(default_factory=EnvArguments)


@command(Options)
def main(args: Options) -> None:
    """Run the command."""
    import cyclic_env.rendering.figures  # noqa: F401 (before the run: it says what to do where matplotlib is missing)
    from cyclic_env.rendering.gif import GifWriter

    settings = {"noise": noise_presets(args.noise), **args.env.settings()}
    contestant = load_contestant(args.agent, args.action_type, map_name=args.map, **settings)
    env = CyclicLoopEnv(args.map, action_type=contestant.action_type, **settings)
    out = args.out or Path("out") / Path(args.agent).stem
    files = [out / name for name in ("run.png", "metrics.json", "run.gif")[: 2 if args.no_gif else 3]]
    check_outputs(files)
    animation = None if args.no_gif else GifWriter(env)
    metrics: dict[str, Any] = {}
    with interruptible() as interruption:
        drive(env, contestant.policy, args.seed, metrics, animation)
    if interruption and not metrics["steps"]:
        raise interruption.stopped("there was no step yet, so there is nothing to keep.")
    metrics |= {"agent": args.agent, "map": env.floor_plan.name, "noise": args.noise, "seed": args.seed}
    print(
        format_rows(
            {
                "run": f"{args.agent}, {metrics['map']}, {args.noise} sensors, seed {args.seed}",
                **score_rows(metrics),
                "return": f"{metrics['return']:.1f}",
                "collisions": f"{metrics['collisions']}",
                "steps": f"{metrics['steps']:,}",
            }
        )
    )
    write_text_atomically(files[1], json.dumps(metrics | {"cyclic_env": __version__}, indent=1) + "\n")
    draw_run(env, metrics, files[0])
    if animation is not None:
        animation.take(metrics["steps"], last=True)
        animation.write(files[2])
    written = ", ".join(map(str, files))
    if interruption:
        raise interruption.stopped(f"the {metrics['steps']:,} steps up to here are in {written}.")
    print(f"\nwritten: {written}")


def drive(
    env: CyclicLoopEnv, policy: Any, seed: int, metrics: dict[str, Any], animation: GifWriter | None = None
) -> None:
    """Run an episode to its end, and write return, steps and the scalars of the last info into `metrics`.

    So it does, too, when it is interrupted.
    """
    steps, total, state, ended = 0, 0.0, None, False
    info: dict[str, Any] = {}
    try:
        with progress_bar(unit="step") as progress:
            observation, info = env.reset(seed=seed)
            progress.reset(total=env.step_budget)
            while not ended:
                if animation is not None:
                    animation.take(steps)
                action, state = policy.predict(observation, state)
                observation, reward, terminated, truncated, info = env.step(action)
                steps, total, ended = steps + 1, total + float(reward), terminated or truncated
                progress.update()
    finally:
        scalars = {name: value for name, value in info.items() if name != "reward_terms"}
        metrics.update({**scalars, "return": total, "steps": steps})


def draw_run(env: CyclicLoopEnv, metrics: dict[str, Any], file: Path) -> None:
    """Write the figure of a run: the true path, and the claims where they truly were."""
    from cyclic_env.rendering.figures import add_legend, draw_claims, draw_path, plan_figure

    plan, path = env.floor_plan, env.trajectory()
    scores = [
        f"{metrics['cycles_closed']} of {metrics['cycles_total']} cycles closed",
        f"{metrics['false_claims']} false claims",
        f"{metrics['coverage']:.1%} seen",
        f"{metrics['path_length_m']:,.0f} m driven",
        f"{metrics['agent']}, {metrics['noise']} sensors",
    ]
    figure, axes = plan_figure(plan, plan.title or plan.name, "   ".join(scores))
    draw_path(axes, path)
    draw_claims(axes, path, env.claims())
    add_legend(axes)
    with atomic_write(file) as part:
        figure.savefig(part, dpi=FIGURE_DPI)
