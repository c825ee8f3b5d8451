"""Reading and writing of occupancy grids as maps of ROS' ``map_server``, a YAML file with an image."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from cyclic_env.atomic_write import atomic_write, write_text_atomically
from cyclic_env.errors import FloorPlanError
from cyclic_env.floor_plans.floor_plan import Pose
from cyclic_env.floor_plans.occupancy.grid import (
    CELLS_MAX,
    FREE,
    FREE_BELOW,
    OCCUPIED,
    UNKNOWN,
    OccupancyGrid,
    check_resolution,
    check_size,
)
from cyclic_env.floor_plans.strict_yaml import as_list, as_number, as_start, as_text, dump_yaml, name_of, read_yaml
from cyclic_env.validation import short_repr, unknown_name

if TYPE_CHECKING:
    from PIL.Image import Image

KEYS = ("image", "resolution", "origin")
MODES = ("trinary", "scale", "raw")
IMAGE_SUFFIXES = (".bmp", ".gif", ".jpeg", ".jpg", ".pgm", ".png", ".pnm", ".ppm", ".tif", ".tiff", ".webp")

OCCUPIED_THRESH, FREE_THRESH = 0.65, 0.196
"""The thresholds that ``map_saver`` writes; they make its grey of unknown cells, 205, unknown."""

SHADES = {OCCUPIED: 0, UNKNOWN: 205, FREE: 254}
"""The shades in which ``map_saver`` paints cells."""


class _Reading(NamedTuple):
    """How the shades of an image are to be read as occupancy."""

    mode: str
    negate: bool
    occupied_thresh: float
    free_thresh: float
    on_white: bool  # transparent pixels are white, as in a drawing; the alpha channel of a map has its own meaning


def read_occupancy_grid(path: str | Path, resolution: float | None = None) -> OccupancyGrid:
    """Read a map of ROS' ``map_server``, or a plain picture in which walls are dark.

    Parameters
    ----------
    path : path
        The YAML file of a map, or a picture.
    resolution : float, optional
        Metres per pixel; required for a picture, refused for a map, whose file states it.

    Raises
    ------
    FloorPlanError
        Naming the file and the key, if a file can't be read or does not follow the format.
    """
    path = Path(path)
    if path.suffix.lower() not in IMAGE_SUFFIXES:
        if resolution is not None:
            raise FloorPlanError(f"{path}: the file itself states the size of a pixel; a resolution is for pictures.")
        data = read_yaml(path)
    elif resolution is None:
        raise FloorPlanError(
            f"{path}: a picture does not say how large a pixel is; give a resolution, metres per pixel."
        )
    else:
        data = {"image": path.name, "resolution": resolution, "origin": [0, 0, 0]}
    try:
        return occupancy_grid_from_mapping(data, path, on_white=resolution is not None)
    except FloorPlanError as error:
        raise FloorPlanError(f"{path}: {error}") from error


def occupancy_grid_from_mapping(data: Any, path: str | Path, *, on_white: bool = False) -> OccupancyGrid:
    """Return the grid that a mapping in the format of ``map_server`` describes.

    It is read as ``nav2_map_server`` reads it, with two differences. First, if an image has only the shades that
    ``map_saver`` paints, its grey is unknown even with the ``free_thresh`` of 0.25 that older versions wrote, which
    would make it free. Second, the keys ``negate``, ``mode`` and the thresholds may be left out. Keys that
    ``map_server`` does not know are ignored, except ``name``, ``title``, ``source``, ``licence`` and ``start``, which
    mean what they mean in a floor plan.

    Parameters
    ----------
    data : mapping
        The keys ``image``, ``resolution``, ``origin``, ``negate``, ``occupied_thresh``, ``free_thresh``, ``mode``.
    path : path
        The YAML file that the mapping is from; the path of the image is relative to its folder.
    on_white : bool
        Whether transparent pixels are white, as in a drawing.

    Raises
    ------
    FloorPlanError
        Naming the key that is missing or malformed, or the image that can't be read.
    """
    if not isinstance(data, Mapping):
        got = "an empty file" if data is None else short_repr(data)
        raise FloorPlanError(f"a map is a mapping with the keys {', '.join(KEYS)}; got {got}.")
    for key in KEYS:
        if key not in data:
            raise FloorPlanError(f"{key}: is missing; a map has the keys {', '.join(KEYS)}.")
    image = data["image"]
    if not isinstance(image, str) or image.splitlines() != [image]:
        raise FloorPlanError(f"image: expected the path of a picture, got {short_repr(image)}.")
    resolution = as_number(data["resolution"], "resolution")
    check_resolution(resolution)
    origin, reading = _origin(data), _reading(data, on_white)
    cells, doubtful = _occupancy(_decoded(Path(path).parent / image), reading)
    return OccupancyGrid(
        cells=cells[::-1],
        resolution=resolution,
        origin=origin,
        name=as_text(data, "name") or name_of(Path(path)),
        title=as_text(data, "title"),
        source=as_text(data, "source"),
        licence=as_text(data, "licence"),
        start=as_start(data["start"]) if "start" in data else None,
        doubtful=doubtful,
    )


def _origin(data: Mapping[str, Any]) -> Pose:
    origin = as_list(data["origin"], "origin")
    if len(origin) != 3:
        raise FloorPlanError(f"origin: expected [x, y, yaw], got {short_repr(origin)}.")
    x, y, yaw = (as_number(value, f"origin[{i}]") for i, value in enumerate(origin))
    return x, y, yaw


def _reading(data: Mapping[str, Any], on_white: bool) -> _Reading:
    negate = data.get("negate", 0)
    if negate not in (0, 1):
        raise FloorPlanError(f"negate: expected 0 or 1, got {short_repr(negate)}.")
    occupied_thresh = as_number(data.get("occupied_thresh", OCCUPIED_THRESH), "occupied_thresh")
    free_thresh = as_number(data.get("free_thresh", FREE_THRESH), "free_thresh")
    if not 0 <= free_thresh < occupied_thresh <= 1:
        raise FloorPlanError(
            f"free_thresh is {free_thresh:g} and occupied_thresh {occupied_thresh:g}; expected shares from 0 to 1, "
            "the first below the second."
        )
    mode = data.get("mode", MODES[0])
    if not isinstance(mode, str) or mode.lower() not in MODES:
        raise FloorPlanError(f"mode: {unknown_name('mode', mode, MODES)}")
    return _Reading(mode.lower(), bool(negate), occupied_thresh, free_thresh, on_white)


def _decoded(path: Path) -> Image:
    """Read and decode a picture, after a check of its size.

    Raises
    ------
    FloorPlanError
        If the file is missing, not a picture, or too large.
    """
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # the size is checked here
            picture = Image.open(path)
        with picture:
            check_size(picture.height, picture.width)
            picture.load()
        if picture.mode == "F" or (
            picture.mode == "I" and not 0 <= np.asarray(picture).min() <= np.asarray(picture).max() < 2**16
        ):
            raise FloorPlanError("its pixels have 32 bits; save it with 8 or 16.")
        return picture
    except FloorPlanError as error:
        raise FloorPlanError(f"image: {path}: {error}") from error
    except FileNotFoundError as error:
        raise FloorPlanError(f"image: there is no file {path}.") from error
    except Image.DecompressionBombError as error:
        raise FloorPlanError(
            f"image: {path}: the image is far too large; a map has at most {CELLS_MAX / 1e6:g} million pixels."
        ) from error
    except (OSError, ValueError, SyntaxError, EOFError) as error:  # what Pillow raises for a damaged file
        reason = getattr(error, "strerror", None) or " ".join(str(error).split()).rstrip(".")
        raise FloorPlanError(f"image: {path} is no complete picture of a known format ({reason}).") from error


def _occupancy(picture: Image, reading: _Reading) -> tuple[np.ndarray, int]:
    """Return the cells of a picture, `(rows, columns)` int8, row 0 at the top, and how many of them are doubtful."""
    mode, negate, occupied_thresh, free_thresh, on_white = reading
    total, weight, transparent = _shades(picture, alpha_counts=mode == "trinary", on_white=on_white)
    levels = np.arange(255 * weight + 1)  # sums of `weight` channels
    white = 255 * weight
    occupied = (levels if negate else white - levels) / white
    if mode == "raw":
        percent = np.rint(levels / weight)
        table = np.where(percent <= OCCUPIED, percent, UNKNOWN)
    else:
        between = (occupied - free_thresh) / (occupied_thresh - free_thresh)
        table = np.rint(100 * between) if mode == "scale" else np.full(len(levels), UNKNOWN)
        table = np.where(occupied > occupied_thresh, OCCUPIED, np.where(occupied < free_thresh, FREE, table))
    counts = np.bincount(total.ravel(), minlength=len(levels))
    if mode == "trinary" and not negate and set(np.flatnonzero(counts) / weight) <= set(SHADES.values()):
        table[weight * SHADES[UNKNOWN]] = UNKNOWN
    doubtful = 0
    if mode == "trinary":
        unknown = np.where(table == UNKNOWN, counts, 0)
        unknown[np.argmax(unknown)] = 0  # the grey of cells that were never seen
        doubtful = int(unknown[occupied < FREE_BELOW / 100].sum())
    cells = table.astype(np.int8)[total]
    if mode == "scale" and transparent is not None:
        cells[transparent] = UNKNOWN
    return cells, doubtful


def _shades(picture: Image, *, alpha_counts: bool, on_white: bool) -> tuple[np.ndarray, int, np.ndarray | None]:
    """Return the sum of the channels of each pixel, the number of channels, and which pixels are not opaque, if any.

    A channel is from 0 to 255. ``map_server`` averages red, green and blue, in the mode trinary also the alpha channel.
    """
    from PIL import Image

    if picture.mode.startswith("I"):  # 16 bits
        return (np.asarray(picture) // 257).clip(0, 255).astype(np.uint8), 1, None
    if not picture.has_transparency_data:
        if picture.mode in ("1", "L"):
            return np.asarray(picture.convert("L")), 1, None
        return np.asarray(picture.convert("RGB")).sum(axis=2, dtype=np.uint16), 3, None
    channels = picture.convert("RGBA")
    if on_white:
        white = Image.new("RGBA", channels.size, "white")
        return np.asarray(Image.alpha_composite(white, channels))[..., :3].sum(axis=2, dtype=np.uint16), 3, None
    values = np.asarray(channels)
    weight = 4 if alpha_counts else 3
    return values[..., :weight].sum(axis=2, dtype=np.uint16), weight, values[..., 3] < 255


def write_occupancy_grid(grid: OccupancyGrid, path: str | Path) -> None:
    """Write a grid as a map of ``map_server`` in the mode trinary: a YAML file and a PGM image of the same name.

    Cells between the thresholds of ``map_server`` are written as unknown.

    Raises
    ------
    FloorPlanError
        If a file can't be written.
    """
    from PIL import Image

    path = Path(path)
    image = path.with_suffix(".pgm")
    shades = np.full(grid.cells.shape, SHADES[UNKNOWN], np.uint8)
    shades[(grid.cells >= FREE) & (grid.cells < 100 * FREE_THRESH)] = SHADES[FREE]
    shades[grid.cells > 100 * OCCUPIED_THRESH] = SHADES[OCCUPIED]
    data: dict[str, Any] = {
        "image": image.name,
        "mode": MODES[0],
        "resolution": float(grid.resolution),
        "origin": [float(value) for value in grid.origin],
        "negate": 0,
        "occupied_thresh": OCCUPIED_THRESH,
        "free_thresh": FREE_THRESH,
        **{name: getattr(grid, name) for name in ("name", "title", "source", "licence")},
    }
    if grid.start is not None:
        data["start"] = dict(zip(("x", "y", "heading"), map(float, grid.start), strict=True))
    try:
        with atomic_write(image) as part:
            Image.fromarray(np.ascontiguousarray(shades[::-1])).save(part, "PPM")
        write_text_atomically(path, dump_yaml(data))
    except OSError as error:
        raise FloorPlanError(f"{path}: can't be written: {error.strerror or error}.") from error
