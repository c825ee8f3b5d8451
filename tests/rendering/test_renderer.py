from __future__ import annotations

import math
import os
import pickle
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

from cyclic_env.envs.cyclic_loop import CyclicLoopEnv
from cyclic_env.envs.vector import CyclicLoopVectorEnv
from cyclic_env.errors import ConfigError
from cyclic_env.floor_plans import FloorPlan, PlanPool, load_floor_plan, load_floor_plans
from cyclic_env.rendering.colors import AMBER, RIGHT, WRONG

pygame = pytest.importorskip("pygame")

from cyclic_env.rendering.scene import FOOTER, HEADER, SIZE_MAX, Scene, canvas_size, scene_of  # noqa: E402

LAP = [(24.0, 0.0), (24.0, 14.0), (0.0, 14.0), (0.0, 0.0), (10.0, 0.0)]
"""Once around the ring, back to where a claim is right."""


def begun(plan: Any, **settings: Any) -> CyclicLoopEnv:
    """Return an environment that draws, after its reset."""
    env = CyclicLoopEnv(plan, render_mode="rgb_array", **settings)
    env.reset(seed=0)
    return env


@pytest.fixture
def env() -> Iterator[CyclicLoopEnv]:
    env = begun("ring")
    yield env
    env.close()


def scene(env: CyclicLoopEnv) -> Scene:
    return scene_of(env.floor_plan, canvas_size(PlanPool((env.floor_plan,))))


def forward(env: CyclicLoopEnv, steps: int) -> None:
    for _ in range(steps):
        env.step([1.0, 1.0, -1.0, 0.0])


def drive_to(env: CyclicLoopEnv, x: float, y: float) -> None:
    """Drive straight to (x, y), by the true pose."""
    for _ in range(1000):
        pose = env.engine.info[0]
        east, north = x - pose["x"], y - pose["y"]
        if math.hypot(east, north) < 0.5:
            return
        error = math.remainder(math.atan2(north, east) - pose["heading"], 2 * math.pi)
        speed, swing = max(0.0, 1 - abs(error)), min(max(0.5 * error, -0.4), 0.4)
        env.step([speed - swing, speed + swing, -1.0, 0.0])
    raise AssertionError(f"never came to ({x}, {y})")


def frame_of(env: CyclicLoopEnv) -> np.ndarray:
    frame = env.render()
    assert isinstance(frame, np.ndarray)
    return frame


def count_near(frame: np.ndarray, color: tuple[int, int, int], place: Any, radius: int = 5) -> int:
    """Count the pixels of about that colour around a place (column, row)."""
    column, row = np.round(place).astype(int)
    part = frame[row - radius : row + radius + 1, column - radius : column + radius + 1].astype(int)
    return int((np.abs(part - np.array(color)).max(axis=-1) < 12).sum())


def test_frame_is_an_rgb_picture_with_even_sides_and_no_larger_than_a_screen(plan: FloorPlan) -> None:
    env = begun(plan)
    frame = frame_of(env)
    height, width, channels = frame.shape
    assert frame.dtype == np.uint8
    assert channels == 3
    assert height % 2 == width % 2 == 0
    assert width <= SIZE_MAX[0]
    assert height <= SIZE_MAX[1]


@pytest.mark.parametrize(("width", "height"), [(2.0, 2.0), (200.0, 4.0), (4.0, 200.0), (120.0, 120.0), (1000.0, 700.0)])
def test_any_shape_of_building_lies_within_the_picture_and_clear_of_the_close_up(width: float, height: float) -> None:
    plan = FloorPlan("room", shapely.box(-7, 3, -7 + width, 3 + height), (-6.0, 4.0, 0.0))
    scene = scene_of(plan, canvas_size(PlanPool((plan,))))
    west, south, east, north = plan.bounds
    (left, top), (right, bottom) = scene.view.pixels([(west, north), (east, south)])
    assert left >= 0
    assert right <= scene.size[0]
    assert top >= HEADER
    assert bottom <= scene.size[1] - FOOTER
    assert (scene.inset is not None) == (scene.view.scale < 12)
    if scene.inset is not None:
        assert pygame.Rect(0, HEADER, scene.size[0], scene.size[1] - HEADER - FOOTER).contains(scene.inset)
        assert scene.inset.left > right or scene.inset.top > bottom


def test_close_up_covers_no_corridor_of_killian_court() -> None:
    plan = load_floor_plan("killian_court")
    scene = scene_of(plan, canvas_size(PlanPool((plan,))))
    assert scene.inset is not None
    assert (scene.overlay.subsurface(scene.inset).get_at((5, 5))).a == 255
    alpha = pygame.surfarray.array_alpha(scene.overlay.subsurface(scene.inset))
    assert (alpha == 255).all()  # transparent is the free space


def test_two_plans_of_a_pool_have_frames_of_one_size() -> None:
    env = CyclicLoopEnv(["ring", "grid"], render_mode="rgb_array")
    shapes = set()
    names = set()
    for seed in range(8):
        env.reset(seed=seed)
        names.add(env.floor_plan.name)
        shapes.add(frame_of(env).shape)
    assert names == {"ring", "grid"}
    assert len(shapes) == 1


def test_north_is_up(env: CyclicLoopEnv) -> None:
    view = scene(env).view
    assert view.pixels((0.0, 10.0))[1] < view.pixels((0.0, 0.0))[1]
    assert view.pixels((10.0, 0.0))[0] > view.pixels((0.0, 0.0))[0]


def test_robot_is_drawn_where_it_is(env: CyclicLoopEnv) -> None:
    forward(env, 10)
    info = env.engine.info[0]
    assert count_near(frame_of(env), AMBER, scene(env).view.pixels((info["x"], info["y"]))) > 20


def test_frame_does_not_depend_on_the_frames_before(env: CyclicLoopEnv) -> None:
    other = begun("ring")
    for _ in range(10):
        forward(env, 1)
        env.render()
        forward(other, 1)
    assert np.array_equal(frame_of(env), frame_of(other))


def colors_at(env: CyclicLoopEnv, position: Any) -> tuple[int, int]:
    """Count the pixels in the colours of right and of wrong claims around a position of the world."""
    frame, place = frame_of(env), scene(env).view.pixels(position)
    return count_near(frame, RIGHT, place), count_near(frame, WRONG, place)


def test_false_claim_is_red_where_it_was_made_long_after(env: CyclicLoopEnv) -> None:
    forward(env, 30)
    env.step([1.0, 1.0, 1.0, -1.0])  # 7 m from the start
    info = env.engine.info[0].copy()
    assert info["false_claims"] == 1
    forward(env, 20)
    right, wrong = colors_at(env, (info["x"], info["y"]))
    assert wrong > 20
    assert right == 0


def test_line_leads_from_a_false_claim_to_the_place_that_it_named(env: CyclicLoopEnv) -> None:
    for x, y in LAP[:3]:
        drive_to(env, x, y)
    env.step([0.0, 0.0, 1.0, -1.0])
    claim, track = env.engine.claims(0)[0], env.trajectory()
    assert not claim["correct"]
    assert colors_at(env, (track[claim["step"], :2] + track[claim["match"], :2]) / 2)[1] > 4


def test_correct_claim_is_green_where_it_was_made(env: CyclicLoopEnv) -> None:
    for x, y in LAP:
        drive_to(env, x, y)
    env.step([0.0, 0.0, 1.0, -1.0])
    info = env.engine.info[0]
    assert info["claim_correct"]
    right, wrong = colors_at(env, (info["x"], info["y"]))
    assert right > 20
    assert wrong == 0


def test_frames_need_no_display() -> None:
    code = (
        "import cyclic_env.envs.cyclic_loop as e\n"
        "env = e.CyclicLoopEnv('killian_court', render_mode='rgb_array')\n"
        "env.reset(seed=0)\n"
        "env.render()\n"
        "import pygame\n"
        "assert not pygame.display.get_init()\n"
    )
    hidden = ("SDL_VIDEODRIVER", "DISPLAY", "WAYLAND_DISPLAY", "PYGAME_HIDE_SUPPORT_PROMPT")
    result = subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        env={name: value for name, value in os.environ.items() if name not in hidden},
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout == ""  # pygame's greeting would be in somebody's data


def test_missing_pygame_is_an_error_that_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    env = begun("ring")
    monkeypatch.setitem(sys.modules, "pygame", None)
    for name in ("renderer", "scene", "primitives"):
        monkeypatch.delitem(sys.modules, f"cyclic_env.rendering.{name}", raising=False)
    with pytest.raises(ConfigError, match=r'pip install "cyclic-loop\[render\]"'):
        env.render()


@pytest.fixture
def window(dummy_display: None) -> Iterator[CyclicLoopEnv]:
    """An environment that shows itself in a window, after its reset."""
    env = CyclicLoopEnv("ring", render_mode="human")
    env.metadata = {**env.metadata, "render_fps": 1000}
    env.reset(seed=0)
    yield env
    env.close()


other_window = window


def close_window(env: CyclicLoopEnv) -> None:
    """Close the window as its user does."""
    pygame.event.post(pygame.event.Event(pygame.WINDOWCLOSE, window=env._renderer._window._window))


def test_run_goes_on_when_the_user_closes_the_window(window: CyclicLoopEnv) -> None:
    close_window(window)
    forward(window, 3)
    assert not window._renderer._window.is_open()
    window.reset()


def test_two_windows_are_closed_one_by_one(window: CyclicLoopEnv, other_window: CyclicLoopEnv) -> None:
    close_window(other_window)
    for env in (window, other_window):
        forward(env, 1)
    assert window._renderer._window.is_open()
    assert not other_window._renderer._window.is_open()


def test_frames_are_the_same_beside_a_window_and_survive_somebody_elses_quitting_of_pygame(
    env: CyclicLoopEnv, dummy_display: None, request: pytest.FixtureRequest
) -> None:
    before = frame_of(env)
    window = request.getfixturevalue("window")
    assert np.array_equal(before, frame_of(env))
    pygame.quit()
    forward(window, 1)
    window.close()
    assert np.array_equal(before, frame_of(env))
    forward(env, 1)
    frame_of(env)


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere there is always a display")
def test_window_without_a_display_is_one_clear_error(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("SDL_VIDEODRIVER", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    pygame.display.quit()
    with pytest.raises(ConfigError, match='render_mode="rgb_array"'):
        CyclicLoopEnv("ring", render_mode="human").reset(seed=0)
    assert not pygame.display.get_init()


def test_vector_env_renders_a_frame_of_every_row() -> None:
    env = CyclicLoopVectorEnv(3, "ring", render_mode="rgb_array")
    env.reset(seed=0, options={"start": [(10.0, 0.0, 0.0), (12.0, 0.0, 0.0), (10.0, 0.0, 0.0)]})
    frames = env.render()
    assert frames is not None
    assert len(frames) == 3
    assert np.array_equal(frames[0], frames[2])
    assert not np.array_equal(frames[0], frames[1])
    env.close()


def test_row_of_a_vector_env_looks_like_a_single_env(env: CyclicLoopEnv) -> None:
    vector = CyclicLoopVectorEnv(2, "ring", render_mode="rgb_array")
    vector.reset(seed=0)
    for _ in range(5):
        vector.step(np.tile([1.0, 1.0, -1.0, 0.0], (2, 1)))
    forward(env, 5)
    frames = vector.render()
    assert frames is not None
    assert np.array_equal(frames[0], frame_of(env))
    vector.close()


def test_env_that_has_rendered_can_be_pickled(env: CyclicLoopEnv) -> None:
    forward(env, 5)
    frame = frame_of(env)
    assert np.array_equal(frame_of(pickle.loads(pickle.dumps(env))), frame)


def test_pictures_of_a_pool_with_plans_yet_to_be_drawn_are_as_large_as_any() -> None:
    assert canvas_size(load_floor_plans(["ring", "generated:train"])) == SIZE_MAX
