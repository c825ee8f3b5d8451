"""Playing by hand: what keys, clicks and claims do, without a window and in one that nobody sees."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

from cyclic_env import ConfigError, CyclicLoopEnv, Recorder, read_recording, replay
from cyclic_env.rendering.colors import AMBER
from cyclic_env.trajectory.dead_reckoning import dead_reckon
from scripts.game.game import Play, Show
from tests.helpers import load_script
from tests.scripts.conftest import Refused

pygame = pytest.importorskip("pygame")

from cyclic_env.rendering.window import Window  # noqa: E402 (these need pygame)
from scripts.game.view import STRIP, draw_play, play_size, play_view  # noqa: E402

main = load_script("play").main

LAP = [(24.0, 0.0), (24.0, 14.0), (0.0, 14.0), (0.0, 0.0), (10.5, 0.0)]
"""Once around the ring, not quite to the start: there a claim is right, and ends the episode."""


def make(show: Show = "truth", noise: str = "ideal", name: str = "ring") -> Play:
    return Play(Recorder(CyclicLoopEnv(name, noise=noise)), show=show)


def drive(play: Play, *held: str, steps: int = 1) -> None:
    play.held = set(held)
    for _ in range(steps):
        play.tick()


def drive_to(play: Play, x: float, y: float) -> None:
    """Hold the keys that lead to (x, y), by the true pose."""
    for _ in range(1000):
        east, north = x - play.info["x"], y - play.info["y"]
        if math.hypot(east, north) < 0.7:
            return
        error = math.remainder(math.atan2(north, east) - play.info["heading"], math.tau)
        turn = {"left"} if error > 0.1 else {"right"} if error < -0.1 else set()
        drive(play, *turn, *({"forward"} if abs(error) < 0.6 else ()))
    raise AssertionError(f"never came to ({x}, {y})")


def test_arrows_drive_and_turn_as_they_point() -> None:
    play = make()
    x, _, heading = play.pose
    drive(play, "forward", steps=10)
    assert play.pose[0] > x + 1.5
    drive(play, "left", steps=5)
    assert 0.4 < play.pose[2] - heading < 1.2
    drive(play, "right", steps=10)
    assert play.pose[2] < heading - 0.3
    before = play.info["path_length_m"]
    drive(play, "forward", "back", steps=3)
    assert play.info["path_length_m"] - before < 0.2  # it rolls out
    actions = {"forward": [1, 1], "back": [-1, -1], "forward slow": [0.4, 0.4], "left slow": [-0.06, 0.06]}
    for held, wheels in actions.items():
        play.held = set(held.split())
        assert play.action()[:2] == pytest.approx(wheels)
    play.held = {"forward", "left"}
    left, right = play.action()[:2]
    assert left < right <= 1


def test_the_clock_starts_with_the_first_key() -> None:
    play = make()
    drive(play, steps=3)
    drive(play, "slow", steps=3)
    play.claim()
    play.tick()
    assert (play.steps, play.started) == (0, False)
    drive(play, "left")
    drive(play, steps=2)
    assert play.steps == 3
    play.restart()
    drive(play, steps=2)
    assert play.steps == 0


@pytest.mark.parametrize("show", ["truth", "robot"])
def test_a_lap_and_a_claim_of_the_nearest_place_succeed(show: Show) -> None:
    play = make(show)
    drive(play, "forward", steps=30)
    play.claim()
    assert play.message.startswith("nothing to claim yet")
    for x, y in LAP:
        drive_to(play, x, y)
    place = play.candidate()
    assert place is not None
    assert math.hypot(*(play.positions[place] - play.pose[:2])) < 3
    play.claim()
    play.tick()
    assert (play.info["cycles_closed"], play.info["false_claims"]) == (1, 0)
    assert play.core.claims()["match"].tolist() == [place]
    assert play.ended
    assert play.message == "success: everything seen, all cycles closed"
    steps = play.steps
    drive(play, "forward", steps=3)
    assert play.steps == steps


def test_the_picked_place_is_the_one_that_is_claimed() -> None:
    play = make()
    for x, y in LAP[:2]:
        drive_to(play, x, y)
    play.pick((23.0, 0.3))
    place = play.candidate()
    assert place is not None
    assert math.hypot(*(play.positions[place] - [23.0, 0.3])) < 0.6
    play.claim()
    play.tick()
    assert play.core.claims()["match"].tolist() == [place]
    assert (play.info["claims"], play.info["false_claims"]) == (1, 1)
    assert play.message.endswith("; false")
    assert play.candidate() != place  # the nearest again
    play.pick((23.0, 0.3))
    play.unpick()
    assert play.candidate() != place


def test_the_robot_is_not_told_whether_its_claim_was_right() -> None:
    play = make("robot", name="figure_eight")
    drive(play, "forward", steps=20)
    play.pick(play.positions[0])
    play.claim()
    play.tick()
    assert play.message == f"claimed: I was here at step 0, {play.track[-1, 3]:.0f} m ago"


def test_the_robot_is_shown_where_dead_reckoning_puts_it() -> None:
    play = make("robot", "poor")
    drive(play, "forward", "left", steps=15)
    drive(play, "forward", steps=15)
    assert isinstance(play.env, Recorder)
    kept = play.env.recording()
    assert play.track[:, :3] == pytest.approx(dead_reckon(kept.distance, kept.compass, kept.poses[0, :2]), abs=1e-9)
    assert math.hypot(play.pose[0] - play.info["x"], play.pose[1] - play.info["y"]) > 0.01
    assert len(play.cloud) > 100


def test_the_cloud_of_a_true_robot_lies_on_the_walls() -> None:
    play = make("robot")
    drive(play, "forward", steps=30)
    walls = play.core.floor_plan.free_space.boundary
    assert shapely.distance(shapely.points(play.cloud), walls).max() < 0.25


def test_pause_stops_time_and_again_begins_a_new_recording(tmp_path: Path) -> None:
    recorder = Recorder(CyclicLoopEnv("ring", noise="typical"), tmp_path / "run.npz")
    play = Play(recorder, seed=4)
    drive(play, "forward", steps=5)
    play.pause()
    drive(play, "forward", steps=5)
    assert play.steps == 5
    play.pause()
    play.restart()
    assert (play.steps, play.held, play.episode_return) == (0, set(), 0.0)
    drive(play, "back", steps=3)
    recorder.close()
    assert [read_recording(tmp_path / name).steps for name in ("run.npz", "run-2.npz")] == [5, 3]
    assert replay(tmp_path / "run.npz").equal


@pytest.mark.parametrize("show", ["truth", "robot"])
def test_a_click_on_the_ring_around_a_place_picks_it(show: Show) -> None:
    play = make(show)
    drive(play, "forward", steps=30)
    play.pick(play.positions[12])
    picture, view = draw_play(play), play_view(play)
    assert picture.get_size() == play_size(play)
    pixel = view.pixels(play.positions[12])
    around = pygame.surfarray.array3d(picture)[
        int(pixel[0]) - 9 : int(pixel[0]) + 10, int(pixel[1]) - 9 : int(pixel[1]) + 10
    ]
    assert (np.abs(around.astype(int) - AMBER).max(axis=-1) < 12).sum() > 30
    play.unpick()
    play.pick(view.world(pixel))
    assert play.candidate() == 12


def test_all_that_was_sensed_is_in_the_picture() -> None:
    play = make("robot", name="grid")
    for steps in (1, 60):
        drive(play, "forward", steps=steps)
        width, height = play_size(play)
        pixels = play_view(play).pixels(np.concatenate([play.cloud, play.positions]))
        assert (pixels >= 0).all()
        assert (pixels <= [width, height - STRIP]).all()


def events(*keys: int) -> list[Any]:
    """Return events of keys that are pressed and let go."""
    return [pygame.event.Event(kind, key=key) for key in keys for kind in (pygame.KEYDOWN, pygame.KEYUP)]


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch, dummy_display: None) -> Callable[[dict[int, Any]], list[int]]:
    """Return what makes a window post events, or raise, at given frames; it returns a list of the frames shown."""

    def plan(frames: dict[int, Any]) -> list[int]:
        shown: list[int] = []

        def show(self: Window, picture: Any) -> None:
            shown.append(len(shown))
            what = frames.get(len(shown), [])
            if what is KeyboardInterrupt:
                raise KeyboardInterrupt
            for event in what:
                pygame.event.post(event)

        monkeypatch.setattr(Window, "show", show)
        return shown

    return plan


def test_keys_play_from_the_command_line_and_are_recorded(
    script: Callable[[dict[int, Any]], list[int]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    down = pygame.event.Event(pygame.KEYDOWN, key=pygame.K_w)
    lost = pygame.event.Event(pygame.WINDOWFOCUSLOST)
    click = pygame.event.Event(pygame.MOUSEBUTTONDOWN, button=1, pos=(10, 300))
    frames = {
        1: [down],
        21: [lost],
        25: [click, *events(pygame.K_SPACE)],
        30: events(pygame.K_p),
        40: [*events(pygame.K_p), pygame.event.Event(pygame.KEYDOWN, key=pygame.K_RIGHT)],
        45: events(pygame.K_ESCAPE),
    }
    shown = script(frames)
    path = tmp_path / "new" / "run.npz"
    assert main(["--noise", "typical", "--seed", "2", "--record", str(path), "--map", "ring"]) == 0
    assert len(shown) == 45
    outcome = replay(path)
    assert outcome.equal
    kept = outcome.recording
    assert (kept.steps, kept.noise, kept.seed) == (34, "typical", 2)
    assert (kept.actions[:20, 0] == 1).all()
    assert (kept.actions[20:28, :2] == 0).all()
    assert (kept.actions[:, 2] > 0).tolist() == [i == 24 for i in range(34)]
    assert (kept.actions[30:, 0] > kept.actions[30:, 1]).all()
    assert len(kept.claims) == 1
    said = capsys.readouterr().out
    assert f"python scripts/replay.py {path} --human" in said


def test_ctrl_c_keeps_the_recording(script: Callable[[dict[int, Any]], list[int]], tmp_path: Path) -> None:
    script({1: [pygame.event.Event(pygame.KEYDOWN, key=pygame.K_w)], 8: KeyboardInterrupt})
    assert main(["--record", str(tmp_path / "run.npz"), "--show", "truth"]) == 130
    assert replay(tmp_path / "run.npz").equal
    assert read_recording(tmp_path / "run.npz").steps == 7


def test_closing_the_window_ends_and_keeps_the_recording(
    dummy_display: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    show = Window.show
    shown = []

    def close(self: Window, picture: Any) -> None:
        show(self, picture)
        shown.append(0)
        if len(shown) == 1:
            pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=pygame.K_w))
        if len(shown) == 5:
            pygame.event.post(pygame.event.Event(pygame.WINDOWCLOSE, window=self._window))

    monkeypatch.setattr(Window, "show", close)
    assert main(["--record", str(tmp_path / "run.npz"), "--speed", "20"]) == 0
    assert read_recording(tmp_path / "run.npz").steps == 4


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--map", "rin"], "Did you mean 'ring'?"),
        (["--show", "trut"], "'truth'"),
        (["--speed", "0"], "--speed is 0.0; expected a number above 0"),
        (["--record", "tests"], "can't write to tests"),
    ],
)
def test_bad_input_gets_one_line(arguments: list[str], message: str, refused: Refused) -> None:
    assert message in refused(main, arguments)


def test_no_display_gets_one_line(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, refused: Refused) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("SDL_VIDEODRIVER", "x11")
    pygame.display.quit()
    assert "there is no display to show a window on" in refused(main, ["--record", tmp_path / "run.npz"])
    assert list(tmp_path.iterdir()) == []


def test_other_actions_are_refused() -> None:
    with pytest.raises(ConfigError, match="driven by wheels"):
        Play(CyclicLoopEnv("ring", action_type="twist"))
