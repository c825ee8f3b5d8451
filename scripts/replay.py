"""Replay a recorded episode, tell whether the replay is bit-equal, and print its scores."""

from __future__ import annotations

if __name__ == "__main__":
    from _cli import run_script

    run_script(__file__)

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from cyclic_env import CyclicLoopEnv, RecordingError, read_recording, replay
from cyclic_env.atomic_write import check_outputs
from cyclic_env.recording.format import Recording
from cyclic_env.recording.replay import Replay
from cyclic_env.trajectory.metrics import ate
from scripts._arguments import Flag, OptionalFile
from scripts._cli import command, progress_bar
from scripts._tables import format_rows, score_rows

if TYPE_CHECKING:
    from cyclic_env.rendering.gif import GifWriter


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of the command."""

    file: Annotated[Path, Positional, arg(metavar="FILE")]
    """recording of an episode, NPZ"""
    gif: OptionalFile = None
    """write an animation of the episode"""
    human: Flag = False
    """show the episode in a window, in real time"""


@command(Options, "Exit code: 0 bit-equal, 1 not, 2 bad input.")
def main(args: Options) -> int:
    """Run the command; return 0 if the replay is bit-equal, else 1."""
    animation: GifWriter | None = None
    recording = read_recording(args.file)
    if args.gif is not None:
        import cyclic_env.rendering.gif  # noqa: F401 (fails before the replay if something is missing)

        check_outputs([args.gif], [args.file])

    def on_step(env: CyclicLoopEnv, step: int) -> None:
        nonlocal animation
        progress.update(step - progress.n)
        if args.gif is not None:
            from cyclic_env.rendering.gif import GifWriter

            animation = GifWriter(env) if animation is None else animation
            animation.take(step, last=step == recording.steps)

    with progress_bar(recording.steps, "step") as progress:
        try:
            outcome = replay(recording, render_mode="human" if args.human else None, on_step=on_step)
        except RecordingError as error:
            raise RecordingError(f"{args.file}: {error}") from error
    print(report(recording, outcome))
    if animation is not None:
        animation.write(args.gif)
        print(f"\nwritten: {args.gif}")
    return 0 if outcome.equal else 1


def report(recording: Recording, outcome: Replay) -> str:
    """Return the verdict and the scores of the replay, one per line."""
    info, ended = outcome.info, recording.terminated or recording.truncated
    trajectories = {"dead reckoning": (recording.dead_reckoned[:, :2], recording.poses[:, :2])}
    for name, track in recording.tracks.items():
        if len(track) and (track[:, 0] >= 0).all() and (track[:, 0] <= recording.steps).all():
            trajectories[f"{name} track"] = (track[:, 1:3], recording.poses[track[:, 0].astype(int), :2])
    rows = {
        "map, sensors": f"{recording.map}, {recording.noise}, seed {recording.seed}",
        **score_rows(info),
        "ATE RMSE (m)": ", ".join(f"{name} {ate(*pair):.2f}" for name, pair in trajectories.items()),
        "return": f"{outcome.episode_return:.1f}",
        "collisions": f"{info['collisions']}",
        "steps": f"{outcome.steps:,}" + ("" if ended else ", stopped early"),
    }
    return f"{outcome.verdict()}\n{format_rows(rows)}"
