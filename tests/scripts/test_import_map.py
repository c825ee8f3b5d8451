"""The command lines that make floor plans of maps and maps of floor plans, and that draw maps to try them with."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import shapely
import yaml
from PIL import Image

from cyclic_env.floor_plans import OccupancyGrid, load_floor_plan, read_floor_plan, trace_floor_plan
from cyclic_env.floor_plans.occupancy.grid import FREE, OCCUPIED, UNKNOWN
from tests.helpers import load_script
from tests.scripts.conftest import Refused

import_map = load_script("import_map")
make_ros_maps = load_script("make_ros_maps")


@pytest.fixture
def ros_map(tmp_path: Path) -> Path:
    """Return the map of a ring of corridors, 20 m x 16 m, with some specks in it."""
    shades = np.full((360, 440), 205, np.uint8)
    shades[19:341, 19:421] = 0
    shades[20:340, 20:420] = 254
    shades[70:290, 70:370] = 0
    shades[40:44, 100:400:50] = 0
    Image.fromarray(shades).save(tmp_path / "hall.pgm")
    data = {"image": "hall.pgm", "resolution": 0.05, "origin": [-1, -1, 0.5]}
    (tmp_path / "hall.yaml").write_text(yaml.safe_dump(data))
    return tmp_path / "hall.yaml"


def test_a_map_becomes_a_plan_with_a_figure_and_a_table(
    ros_map: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, figure = tmp_path / "new" / "plan.yaml", tmp_path / "new" / "plan.png"
    assert import_map.main([str(ros_map), "--out", str(out), "--figure", str(figure)]) == 0
    plan = load_floor_plan(out)
    assert plan.cycles_total == 1
    assert plan.source == "traced from hall.yaml by scripts/import_map.py"
    plan.reachable(0.25)
    table = capsys.readouterr().out
    assert f"free area  {plan.free_area:,.0f} m2" in table
    assert "cycles  1, of 52 m" in table
    assert "6 specks of 0.1 m2" in table
    with Image.open(figure) as picture:
        assert picture.width > 2 * 10 * import_map.FIGURE_DPI - 5
        assert len(np.unique(np.asarray(picture.convert("L")))) > 10


def test_options_reach_the_tracing(ros_map: Path, tmp_path: Path) -> None:
    out = tmp_path / "plan.yaml"
    start = read_floor_plan(ros_map).start
    arguments = [str(ros_map), "--out", str(out), "--start", f"{start[0]}", f"{start[1]}", "1.5"]
    assert import_map.main([*arguments, "--speck-area", "0", "--nook-area", "0.3", "--gap", "0.1", "--door", "1"]) == 0
    plan = load_floor_plan(out)
    assert plan.start == (start[0], start[1], 1.5)
    assert len(plan.free_space.interiors) == 7
    assert import_map.main([*arguments, "--tolerance", "0.3", "--robot-radius", "0.6"]) == 0
    assert load_floor_plan(out).cycles_total == 1


def test_a_plan_of_the_paper_and_floor_in_grey_are_remarked_upon(
    ros_map: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert import_map.main([str(ros_map)]) == 0
    assert "look" not in capsys.readouterr().out
    paper = np.full((200, 300), 254, np.uint8)
    paper[50:150, 100:200] = 0
    Image.fromarray(paper).save(tmp_path / "paper.png")
    assert import_map.main([str(tmp_path / "paper.png"), "--resolution", "0.1"]) == 0
    assert "look  the plan reaches the image's edge" in capsys.readouterr().out
    grey = np.asarray(Image.open(ros_map.with_suffix(".pgm"))).copy()
    grey[:, 230:][grey[:, 230:] == 254] = 190
    Image.fromarray(np.where(grey == 205, 128, grey)).save(ros_map.with_suffix(".pgm"))
    assert import_map.main([str(ros_map)]) == 0
    said = capsys.readouterr().out
    assert "m2 of light grey are unknown by free_thresh" in said
    assert "no cycle was found" in said


def test_a_picture_needs_a_resolution(ros_map: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture, out = str(ros_map.with_suffix(".pgm")), tmp_path / "plan.yaml"
    assert import_map.main([picture, "--out", str(out)]) == 2
    assert capsys.readouterr().err.startswith(f"import_map.py: {picture}: a picture does not say")
    assert import_map.main([picture, "--resolution", "0.1", "--out", str(out)]) == 0
    assert load_floor_plan(out).bounds == pytest.approx((2, 2, 42, 34), abs=0.01)


def test_plans_and_maps_are_exported(ros_map: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert import_map.main(["ring", "--export", str(tmp_path / "maps"), "--resolution", "0.1"]) == 0
    assert "hall" not in capsys.readouterr().out
    back = read_floor_plan(tmp_path / "maps" / "ring.yaml")
    assert back.free_area == pytest.approx(load_floor_plan("ring").free_area, rel=0.01)
    assert import_map.main([str(ros_map), "--export", str(tmp_path / "maps")]) == 0
    assert {path.name for path in (tmp_path / "maps").iterdir()} == {"ring.yaml", "ring.pgm", "hall.yaml", "hall.pgm"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere.yaml"], "nowhere.yaml: can't be read: No such file"),
        (["empty.yaml"], "empty.yaml is an empty file; expected a map with the keys image"),
        (["no_image.yaml"], "no_image.yaml is neither a map, which has a key `image`, nor a floor plan"),
        (["ring"], "ring is a floor plan already: give --export"),
        (["MAP", "--start", "0", "0", "0"], r"MAP: start (0, 0) is in a wall"),
        (["MAP", "--out", "MAP/plan.yaml"], "can't write to"),
        (["MAP", "--resolution", "0.1"], "MAP itself states the size of a pixel"),
        (["MAP", "--figure", "a.png", "--out", "a.png"], "a.png would be written twice"),
        (["MAP", "--export", "."], "hall.yaml is read, and would be overwritten"),
        (["odd_name.yaml", "--export", "x"], "the plan's name '../hall' is no name of a file"),
    ],
)
def test_bad_input_is_one_line(
    arguments: list[str], message: str, ros_map: Path, monkeypatch: pytest.MonkeyPatch, refused: Refused
) -> None:
    monkeypatch.chdir(ros_map.parent)
    Path("empty.yaml").touch()
    Path("no_image.yaml").write_text("resolution: 5e-2\norigin: [0, 0, 0]\n")
    Path("odd_name.yaml").write_text(ros_map.read_text() + "\nname: ../hall\n")
    before = ros_map.read_bytes()
    arguments = [argument.replace("MAP", str(ros_map)) for argument in arguments]
    said = refused(import_map.main, arguments, before_the_work=False)
    assert message.replace("MAP", str(ros_map)) in said
    assert ros_map.read_bytes() == before


@pytest.mark.parametrize(("name", "cycles"), [("office_floor", 2), ("hospital", 4)])
def test_drawn_buildings_are_large_and_have_their_cycles(
    name: str, cycles: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(make_ros_maps, "MAPS", {name: make_ros_maps.MAPS[name]})
    assert make_ros_maps.main(["--out", str(tmp_path)]) == 0
    with Image.open(tmp_path / f"{name}.pgm") as picture:
        assert picture.width >= 1500
        assert picture.height >= 1000
    plan = read_floor_plan(tmp_path / f"{name}.yaml")
    assert plan.cycles_total == cycles
    assert len(plan.walls) < 300


def test_a_glimpsed_corridor_keeps_its_loop_and_a_glimpsed_yard_is_told() -> None:
    tracing = trace_floor_plan(make_ros_maps.glimpsed_loop())
    assert tracing.plan.cycles_total == 2
    assert tracing.plan.free_space.contains(shapely.LineString([(40, 26), (50, 26)]))
    assert [(round(place.area), place.reason) for place in tracing.dropped] == [(112, "glimpse")]
    assert len(trace_floor_plan(make_ros_maps.glimpsed_loop(), door=0.0).dropped) == 0


def test_kiosks_with_long_rings_and_short_laps_are_no_cycles() -> None:
    plan = trace_floor_plan(make_ros_maps.short_laps()).plan
    rings = sorted(ring.length for ring in plan.free_space.interiors)
    assert [length > 40 for length in rings] == [False] + 6 * [True]
    assert [round(hole.exterior.length) for hole in plan.cycles] == [83, 83]


@pytest.mark.parametrize("radius", [0.25, 0.3, 0.35])
def test_rooms_behind_doors_in_their_corners_are_kept(radius: float) -> None:
    tracing = trace_floor_plan(make_ros_maps.corner_doors(), robot_radius=radius)
    assert tracing.plan.free_area == pytest.approx(8 * 144 + 2.2 * 136.4, rel=0.01)
    assert (tracing.plan.cycles_total, tracing.dropped) == (1, ())


@pytest.fixture(scope="module")
def hut() -> OccupancyGrid:
    """Return the scan of a ring of corridors with two furnished rooms."""
    ring = [(0, 0), (14, 0), (14, 12), (0, 12), (0, 0)]
    model = make_ros_maps.building("hut", "", 2.4, [ring], [((14, 0), (0, 0), 5.5, 2)], furnished=True)
    return make_ros_maps.scan(model, np.random.default_rng(0))


def test_a_scan_has_unknown_space_windows_and_specks(hut: OccupancyGrid) -> None:
    shares = [np.mean(hut.cells == value) for value in (UNKNOWN, FREE, OCCUPIED)]
    assert all(share > 0.005 for share in shares)
    rows, columns = np.nonzero(hut.free)
    yard = hut.to_world(np.stack([columns, rows], axis=1) + 0.5)
    assert np.count_nonzero(yard[:, 1] > 13.5) > 10_000  # seen through windows


def test_a_scan_becomes_a_plan_of_the_building_alone(hut: OccupancyGrid) -> None:
    plan, specks, *_ = trace_floor_plan(hut, start=(2.0, 0.0, 0.0))  # there is more yard than building
    assert plan.cycles_total == 1
    assert plan.free_area == pytest.approx(52 * 2.4 + 2 * 6.8 * 5.5, rel=0.1)
    assert plan.bounds == pytest.approx((-1.2, -6.9, 15.2, 13.2), abs=0.4)
    assert specks > 100
