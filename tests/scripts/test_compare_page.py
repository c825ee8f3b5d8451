"""The page of a comparison in a real browser: no errors, no network, and a replay by keyboard, mouse and touch."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from html import unescape
from pathlib import Path
from typing import Any

import pytest

from tests.helpers import load_script

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
in_browser = pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium here (on Debian: apt install chromium)")

WATCH = """<script>
window.problems = [];
window.addEventListener("error", (event) => window.problems.push(event.message));
for (const kind of ["error", "warn"]) console[kind] = (...said) => window.problems.push(said.join(" "));
</script>"""
HELPERS = """
const canvas = document.getElementById("stage"), { state, view } = window.replay, found = {};
const box = canvas.getBoundingClientRect();
const key = (name, more = {}) => document.body.dispatchEvent(
  new KeyboardEvent("keydown", { key: name, bubbles: true, ...more }));
const pointer = (kind, x, y, id = 1, pointerType = "mouse") => canvas.dispatchEvent(new PointerEvent(kind,
  { clientX: box.left + x, clientY: box.top + y, pointerId: id, pointerType, bubbles: true }));
const report = () => { found.problems = window.problems; document.body.innerHTML = "<pre id=found></pre>";
  document.getElementById("found").textContent = JSON.stringify(found); };
"""


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of two agents on a small building."""
    out = tmp_path_factory.mktemp("comparison")
    arguments = ["--agents", "circling,oracle,frontier", "--maps", "ring", "--noise", "calibrated", "--seeds", "1"]
    assert load_script("compare").main([*arguments, "--processes", "1", "--out", str(out)]) == 0
    return out / "report.html"


def browse(page: Path, script: str, tmp_path: Path, *options: str) -> dict[str, Any]:
    """Return what a script finds in the page, as ``found``, in a browser."""
    text = page.read_text().replace("<head>", "<head>" + WATCH)
    tried = tmp_path / "tried.html"
    tried.write_text(text.replace("</body>", f"<script>{{ {HELPERS} {script} }}</script></body>"))
    flags = ["--headless=new", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'profile'}", *options]
    command = [str(CHROMIUM), *flags, "--dump-dom", tried.as_uri()]
    said = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout
    found = re.search(r'<pre id="found">(.*?)</pre>', said, re.DOTALL)
    assert found is not None, said[-500:]
    return json.loads(unescape(found[1]))


def test_the_page_needs_nothing_from_elsewhere_and_shows_all_agents(page: Path) -> None:
    text = page.read_text()
    assert len(text) < 2_000_000
    assert not re.search(r'(src|href)="(?!data:)', text)
    assert not re.search(r"fetch\(|XMLHttpRequest|import\(", text)
    for agent in ("circling", "oracle", "frontier"):
        assert f"<td>{agent}</td>" in text
    assert "<td>privileged</td>" in text


@in_browser
def test_the_replay_follows_the_keyboard(page: Path, tmp_path: Path) -> None:
    script = """
    const frames = [state.frame];
    for (const name of ["ArrowRight", "ArrowRight", "ArrowLeft", "End", "Home"]) {
      key(name); frames.push(state.frame);
    }
    key("ArrowRight", { shiftKey: true }); frames.push(state.frame);
    const scale = view.scale; key("+");
    const larger = view.scale; key("-"); key("-");
    const smaller = view.scale; key("0");
    Object.assign(found, { frames, last: state.run.frames - 1, scales: [scale, larger, smaller, view.scale] });
    report();"""
    found = browse(page, script, tmp_path)
    assert found["problems"] == []
    assert found["frames"] == [0, 5, 10, 5, found["last"], 0, 50]
    fitted, larger, smaller, again = found["scales"]
    assert larger > fitted > smaller
    assert again == pytest.approx(fitted)


@in_browser
def test_the_replay_follows_the_mouse_and_two_fingers(page: Path, tmp_path: Path) -> None:
    script = """
    const before = [view.x, view.y];
    pointer("pointerdown", 200, 200); pointer("pointermove", 260, 170); pointer("pointerup", 260, 170);
    found.moved = [(before[0] - view.x) * view.scale, (view.y - before[1]) * view.scale];
    const scale = view.scale;
    canvas.dispatchEvent(new WheelEvent("wheel",
      { deltaY: -200, clientX: box.left + 90, clientY: box.top + 90, cancelable: true }));
    found.wheel = view.scale / scale;
    const wheeled = view.scale;
    pointer("pointerdown", 100, 100, 1, "touch"); pointer("pointerdown", 200, 100, 2, "touch");
    pointer("pointermove", 300, 100, 2, "touch"); pointer("pointerup", 300, 100, 2, "touch");
    pointer("pointerup", 100, 100, 1, "touch");
    found.pinch = view.scale / wheeled;
    const slider = document.getElementById("time");
    slider.value = 40; slider.dispatchEvent(new Event("input")); found.frame = state.frame;
    report();"""
    found = browse(page, script, tmp_path)
    assert found["problems"] == []
    assert found["moved"] == pytest.approx([60, -30], abs=1e-6)
    assert found["wheel"] == pytest.approx(2.718281828**0.5, rel=1e-6)
    assert found["pinch"] == pytest.approx(2.0)
    assert found["frame"] == 40


@in_browser
def test_a_claim_shows_its_loop_and_its_winding_numbers_and_closes_its_cycle(page: Path, tmp_path: Path) -> None:
    script = """
    const index = [...document.getElementById("run").options].findIndex((option) => option.text.startsWith("oracle"));
    window.replay.choose(index); window.replay.seek(1e9); window.replay.fit();
    const claim = state.run.claims.find((one) => one[3]), frame = claim[0];
    const x = state.run.poses[3 * frame] * 0.05, y = state.run.poses[3 * frame + 1] * 0.05;
    pointer("pointermove", (x - view.x) * view.scale + view.width / 2, -(y - view.y) * view.scale + view.height / 2);
    const text = (id) => document.getElementById(id).textContent;
    found.tip = text("tip"); found.status = text("status");
    window.replay.seek(0); found.before = text("status");
    report();"""
    found = browse(page, script, tmp_path)
    assert found["problems"] == []
    assert re.search(r"back at step \d+\nright, [\d.]+ m off\nwinding numbers -?1\ncloses a cycle", found["tip"])
    assert "cycles closed 1 of 1" in found["status"]
    assert "cycles closed 0 of 1" in found["before"]


@in_browser
def test_it_plays_and_pauses(page: Path, tmp_path: Path) -> None:
    script = """
    document.getElementById("speed").value = "60"; document.getElementById("speed").dispatchEvent(new Event("change"));
    key(" "); found.playing = state.playing;
    const wait = setInterval(() => {
      if (state.frame === 0) return;
      clearInterval(wait); key(" "); found.paused = !state.playing; report();
    }, 50);"""
    found = browse(page, script, tmp_path, "--virtual-time-budget=60000")
    assert found["problems"] == []
    assert found["playing"]
    assert found["paused"]


@in_browser
def test_it_fits_a_narrow_window(page: Path, tmp_path: Path) -> None:
    script = """
    found.width = document.documentElement.scrollWidth; found.inner = window.innerWidth; found.canvas = box.width;
    report();"""
    found = browse(page, script, tmp_path, "--window-size=500,900")
    assert found["problems"] == []
    assert found["width"] <= found["inner"]
    assert found["canvas"] > 0.8 * found["inner"]
