"""Drive the robot by hand, on any map, claim to be back at known places, and keep a recording of it."""

from __future__ import annotations

if __name__ == "__main__":
    from _cli import run_script

    run_script(__file__)

from dataclasses import dataclass, field

from cyclic_env import ConfigError, CyclicLoopEnv, Recorder
from cyclic_env.validation import short_repr
from scripts._arguments import EnvArguments, EnvOptions, OptionalFile, noise_presets
from scripts._cli import command, interruptible
from scripts._tables import format_rows, score_rows
from scripts.game.game import Play, Show

KEYS = """keys: arrows or WASD drive, with Shift slowly; Space claims to be back at the ringed place of your path, the
nearest one that you left long enough ago, or one that you click on (right click: the nearest again); P pauses, R
restarts, Esc quits. The clock starts when you first drive."""
SPEED_MAX = 20.0


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of the command."""

    map: str = "ring"
    """a shipped plan, a file, or a building such as generated:seed=7"""
    noise: str = "ideal"
    """ideal, calibrated, typical, poor or hard, or several with commas between, of which each reset draws one"""
    seed: int = 0
    """seed of the noise and the random start"""
    show: Show = "robot"
    """robot (what it senses) or truth"""
    speed: float = 2.0
    """speed relative to real time"""
    record: OptionalFile = None
    """record to an NPZ file; restarts are numbered"""
    env: EnvOptions = field(default_factory=EnvArguments)


@command(Options, KEYS)
def main(args: Options) -> None:
    """Run the command."""
    if not 0 < args.speed <= SPEED_MAX:
        raise ConfigError(f"--speed is {short_repr(args.speed)}; expected a number above 0, at most {SPEED_MAX:g}.")
    env = CyclicLoopEnv(args.map, noise=noise_presets(args.noise), **args.env.settings())
    interruption = None
    with Recorder(env, args.record) as recorder:
        play = Play(recorder, seed=args.seed, show=args.show)
        with interruptible() as interruption:
            run(play, args.speed)
        recorder.save()
        print(scores(play))
        if recorder.path is not None and recorder.steps:
            print(f"\nrecorded: {recorder.path}; replay it: python scripts/replay.py {recorder.path} --human")
    if interruption:
        raise interruption.stopped("the scores up to here are above.")


def run(play: Play, speed: float) -> None:
    """Show the game in a window and let the keys control it, until Esc or until the window is closed."""
    from cyclic_env.rendering.primitives import pygame
    from cyclic_env.rendering.window import Window
    from scripts.game.view import draw_play, play_size, play_view

    drives = {
        pygame.K_UP: "forward",
        pygame.K_w: "forward",
        pygame.K_DOWN: "back",
        pygame.K_s: "back",
        pygame.K_LEFT: "left",
        pygame.K_a: "left",
        pygame.K_RIGHT: "right",
        pygame.K_d: "right",
        pygame.K_LSHIFT: "slow",
        pygame.K_RSHIFT: "slow",
    }
    presses = {pygame.K_SPACE: play.claim, pygame.K_p: play.pause, pygame.K_r: play.restart}
    steps_per_s = max(1, round(speed / play.core.config.robot.dt))
    window = Window(play_size(play), steps_per_s, "you can't play without one.")
    try:
        while window.is_open():
            for event in pygame.event.get():
                if event.type == pygame.QUIT or (event.type == pygame.KEYDOWN and event.key == pygame.K_ESCAPE):
                    return
                if event.type == pygame.KEYDOWN and event.key in drives:
                    play.held.add(drives[event.key])
                elif event.type == pygame.KEYUP and event.key in drives:
                    play.held.discard(drives[event.key])
                elif event.type == pygame.KEYDOWN and event.key in presses:
                    presses[event.key]()
                elif event.type == pygame.MOUSEBUTTONDOWN and event.button == 1:
                    play.pick(play_view(play).world(event.pos))
                elif event.type == pygame.MOUSEBUTTONDOWN and event.button == 3:
                    play.unpick()
                elif event.type == pygame.WINDOWFOCUSLOST:
                    play.held.clear()  # releases of keys go to another window now
            play.tick()
            window.show(draw_play(play))
    finally:
        window.close()


def scores(play: Play) -> str:
    """Return the scores, one per line."""
    return format_rows(score_rows(play.info) | {"return": f"{play.episode_return:.1f}", "steps": f"{play.steps:,}"})
