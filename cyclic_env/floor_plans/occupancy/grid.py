"""Occupancy grids: the maps of ROS' ``map_server``, read, written, and drawn from floor plans."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely
import yaml
from scipy import ndimage

from cyclic_env.atomic_write import atomic_write, write_text_atomically
from cyclic_env.errors import FloorPlanError
from cyclic_env.floor_plans.floor_plan import COORDINATE_MAX, FloorPlan, Pose
from cyclic_env.floor_plans.yaml_io import as_list, as_number, as_start, as_text, name_of, read_yaml
from cyclic_env.validation import short_repr, unknown_name

if TYPE_CHECKING:
    from PIL.Image import Image

FREE, OCCUPIED, UNKNOWN = 0, 100, -1
"""Values of a cell, as in ``nav_msgs/OccupancyGrid``; between the first two it is a percentage."""

FREE_BELOW = 50
"""Percentage below which a cell is taken for free: it is more likely free than not."""

MODES = ("trinary", "scale", "raw")
IMAGE_SUFFIXES = (".bmp", ".gif", ".jpeg", ".jpg", ".pgm", ".png", ".pnm", ".ppm", ".tif", ".tiff", ".webp")

OCCUPIED_THRESH, FREE_THRESH = 0.65, 0.196
"""The thresholds that ``map_saver`` writes; they read its grey of unknown cells, 205, as unknown."""

SHADES = {OCCUPIED: 0, UNKNOWN: 205, FREE: 254}
"""What ``map_saver`` paints cells with."""

RESOLUTION_MIN = 1e-6
"""Metres a pixel, at least: floor plans are written to the micrometre."""

CELLS_MAX = 64_000_000
"""Most pixels of an image, such as 8,000 x 8,000: some 3 GB while they are traced."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class OccupancyGrid:
    """A map of square cells, as of ``nav_msgs/OccupancyGrid``, and what is known of it.

    Parameters
    ----------
    cells : (rows, columns) int8
        Percentage of occupancy, 0 (free) to 100 (occupied), or -1 (unknown). Row 0 is the lowest one in y.
    resolution : float
        Side of a cell, metres.
    origin : (x, y, yaw)
        World pose of the outer corner of cell (0, 0), metres and radians: rows and columns are turned by `yaw`,
        counter-clockwise, about it.
    name, title, source, licence : str
        As of a `FloorPlan`.
    start : (x, y, heading), optional
        World pose at which the robot is to start.
    doubtful : int
        Cells that are unknown by the thresholds, but of a shade that says they are more likely free than not.

    Raises
    ------
    FloorPlanError
        If the cells are none or too many, or the resolution is out of range.
    """

    cells: np.ndarray
    resolution: float
    origin: Pose = (0.0, 0.0, 0.0)
    name: str = "unnamed"
    title: str = ""
    source: str = ""
    licence: str = ""
    start: Pose | None = None
    doubtful: int = 0

    def __post_init__(self) -> None:
        if self.cells.ndim != 2:
            raise FloorPlanError(f"an occupancy grid has rows and columns, got an array of shape {self.cells.shape}.")
        _check_size(*self.cells.shape)
        _check_resolution(self.resolution)

    @property
    def free(self) -> np.ndarray:
        """Which cells are free, `(rows, columns)` bool; unknown ones are not."""
        return (self.cells >= FREE) & (self.cells < FREE_BELOW)

    def to_world(self, points: np.ndarray) -> np.ndarray:
        """Return points `(n, 2)` in the grid's frame, as columns and rows from its outer corner, as x, y in metres."""
        x, y, yaw = self.origin
        across, up = self.resolution * np.asarray(points, dtype=float).T
        return np.stack(
            [x + math.cos(yaw) * across - math.sin(yaw) * up, y + math.sin(yaw) * across + math.cos(yaw) * up], axis=1
        )

    def to_grid(self, points: np.ndarray) -> np.ndarray:
        """Return world points `(n, 2)`, metres, as columns and rows from the grid's outer corner: `to_world` undone."""
        x, y, yaw = self.origin
        east, north = (np.asarray(points, dtype=float) - (x, y)).T / self.resolution
        return np.stack(
            [math.cos(yaw) * east + math.sin(yaw) * north, math.cos(yaw) * north - math.sin(yaw) * east], axis=1
        )


def read_occupancy_grid(path: str | Path, resolution: float | None = None) -> OccupancyGrid:
    """Read a map of ROS' ``map_server``, or a plain picture in which walls are dark.

    Parameters
    ----------
    path : path
        Of the YAML file of a map, or of a picture.
    resolution : float, optional
        Metres a pixel, needed for a picture and refused for a map, which has its own.

    Raises
    ------
    FloorPlanError
        Naming the file and the key, if a file can't be read or does not follow the format.
    """
    path = Path(path)
    try:
        if path.suffix.lower() in IMAGE_SUFFIXES:
            if resolution is None:
                raise FloorPlanError("a picture does not say how large a pixel is; give a resolution, metres a pixel.")
            data = {"image": path.name, "resolution": resolution, "origin": [0, 0, 0]}
            return occupancy_grid_from_mapping(data, path, on_white=True)
        if resolution is not None:
            raise FloorPlanError("the file says itself how large a pixel is; give a resolution for a picture only.")
        return occupancy_grid_from_mapping(read_yaml(path), path)
    except FloorPlanError as error:
        raise FloorPlanError(str(error) if str(error).startswith(f"{path}: ") else f"{path}: {error}") from error


def occupancy_grid_from_mapping(data: Any, path: str | Path, *, on_white: bool = False) -> OccupancyGrid:
    """Return the grid that a mapping of ``map_server``'s format describes.

    Read as ``nav2_map_server`` does, with two differences. Where an image has no other shades than those that
    ``map_saver`` paints, its grey is unknown also under the ``free_thresh`` of 0.25 that older ones wrote beside it,
    by which all unknown space would be free. And the keys ``negate``, ``mode`` and the thresholds may be left out.
    Keys that ``map_server`` does not know are passed over, but for ``name``, ``title``, ``source``, ``licence`` and
    ``start``, which mean what they do in a floor plan.

    Parameters
    ----------
    data : mapping
        The keys ``image``, ``resolution``, ``origin``, ``negate``, ``occupied_thresh``, ``free_thresh``, ``mode``.
    path : path
        The YAML file that it is from: the image's path starts at its folder.
    on_white : bool
        Whether what is transparent is white, as in a drawing; a map's alpha channel has its own meaning.

    Raises
    ------
    FloorPlanError
        Naming the key that is missing or malformed, or the image that can't be read.
    """
    if not isinstance(data, Mapping):
        raise FloorPlanError(f"a map is a mapping with the keys image, resolution and origin; got {short_repr(data)}.")
    for key in ("image", "resolution", "origin"):
        if key not in data:
            raise FloorPlanError(f"{key}: is missing; a map has the keys image, resolution and origin.")
    image = data["image"]
    if not isinstance(image, str) or image.splitlines() != [image]:
        raise FloorPlanError(f"image: expected the path of a picture, got {short_repr(image)}.")
    resolution = as_number(data["resolution"], "resolution")
    _check_resolution(resolution)
    origin = as_list(data["origin"], "origin")
    if len(origin) != 3:
        raise FloorPlanError(f"origin: expected [x, y, yaw], got {short_repr(origin)}.")
    x, y, yaw = (as_number(value, f"origin[{i}]") for i, value in enumerate(origin))
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
    picture = _decoded(Path(path).parent / image)
    cells, doubtful = _occupancy(picture, mode.lower(), bool(negate), occupied_thresh, free_thresh, on_white=on_white)
    return OccupancyGrid(
        cells=cells[::-1],
        resolution=resolution,
        origin=(x, y, yaw),
        name=as_text(data, "name") or name_of(Path(path)),
        title=as_text(data, "title"),
        source=as_text(data, "source"),
        licence=as_text(data, "licence"),
        start=as_start(data["start"]) if "start" in data else None,
        doubtful=doubtful,
    )


def _check_resolution(resolution: float) -> None:
    if not RESOLUTION_MIN <= resolution <= COORDINATE_MAX:
        raise FloorPlanError(
            f"resolution: expected metres a pixel, more than 0, got {short_repr(resolution)}; "
            f"possible are {RESOLUTION_MIN:g} to {COORDINATE_MAX:g}."
        )


def _check_size(height: int, width: int) -> None:
    if not 0 < height * width <= CELLS_MAX:
        raise FloorPlanError(
            f"the image has {width:,} x {height:,} pixels; a map has from 1 to {CELLS_MAX / 1e6:g} million: make it "
            "smaller or cut it into parts."
        )


def _decoded(path: Path) -> Image:
    """Return a picture from a file, decoded after a look at its size.

    Raises
    ------
    FloorPlanError
        If it is missing, is no picture, or is too large.
    """
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # the size is checked here
            picture = Image.open(path)
        with picture:
            _check_size(picture.height, picture.width)
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
    except (OSError, ValueError, SyntaxError, EOFError) as error:  # Pillow's, of a broken header or half a file
        reason = getattr(error, "strerror", None) or " ".join(str(error).split()).rstrip(".")
        raise FloorPlanError(f"image: {path} is no whole picture of a format that is known ({reason}).") from error


def _occupancy(
    picture: Image, mode: str, negate: bool, occupied_thresh: float, free_thresh: float, *, on_white: bool
) -> tuple[np.ndarray, int]:
    """Return the cells of a picture, `(rows, columns)` int8, row 0 at the top, and how many of them are doubtful."""
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
        unknown[np.argmax(unknown)] = 0  # the grey of what was never seen
        doubtful = int(unknown[occupied < FREE_BELOW / 100].sum())
    cells = table.astype(np.int8)[total]
    if mode == "scale" and transparent is not None:
        cells[transparent] = UNKNOWN
    return cells, doubtful


def _shades(picture: Image, *, alpha_counts: bool, on_white: bool) -> tuple[np.ndarray, int, np.ndarray | None]:
    """Return for each pixel the sum of its channels of 0 to 255, how many these are, and which are not opaque, if any.

    ``map_server`` takes the mean of red, green and blue and, in the mode trinary, of the alpha channel too.
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


def rasterise(plan: FloorPlan, resolution: float) -> OccupancyGrid:
    """Return a floor plan as a grid: free where a cell's centre is, walls a cell thick around it, unknown beyond.

    A wall too thin to have a cell's centre in it is drawn none the less, a cell thick.

    Parameters
    ----------
    plan : FloorPlan
    resolution : float
        Metres a cell.

    Raises
    ------
    FloorPlanError
        If the resolution is out of range, or makes too many cells or no free one.
    """
    _check_resolution(resolution)
    west, south, east, north = plan.bounds
    x, y = (resolution * (math.floor(low / resolution) - 2) for low in (west, south))
    columns, rows = (math.ceil((high - low) / resolution) + 2 for low, high in ((x, east), (y, north)))
    _check_size(rows, columns)
    free = _inside(plan.walls - (x, y, x, y), resolution, (rows, columns))
    free[_thin_walls(plan, resolution, (x, y))] = False
    if not free.any():
        raise FloorPlanError(
            f"resolution: at {resolution:g} m a pixel {plan.name!r} has no free cell; give a smaller one."
        )
    cells = np.full(free.shape, UNKNOWN, np.int8)
    cells[ndimage.binary_dilation(free, np.ones((3, 3), dtype=int))] = OCCUPIED
    cells[free] = FREE
    about = {name: getattr(plan, name) for name in ("name", "title", "source", "licence", "start")}
    return OccupancyGrid(cells=cells, resolution=resolution, origin=(x, y, 0.0), **about)


def _inside(walls: np.ndarray, resolution: float, shape: tuple[int, int]) -> np.ndarray:
    """Return which cells' centres lie inside closed rings of walls `(W, 4)`, by the parity of crossings to the west."""
    x1, y1, x2, y2 = (walls / resolution - 0.5).T  # a centre is at whole numbers
    first = np.ceil(np.minimum(y1, y2)).astype(int)
    count = np.ceil(np.maximum(y1, y2)).astype(int) - first  # rows first ... first + count - 1 cross the wall
    wall = np.repeat(np.arange(len(walls)), count)
    row = np.arange(len(wall)) - np.repeat(np.cumsum(count) - count, count) + first[wall]
    across = x1[wall] + (row - y1[wall]) * (x2 - x1)[wall] / (y2 - y1)[wall]
    crossings = np.zeros(shape, np.uint8)
    np.add.at(crossings, (row, np.ceil(across).astype(int)), 1)
    return np.bitwise_and(np.cumsum(crossings, axis=1, dtype=np.uint8), 1).astype(bool)


def _thin_walls(plan: FloorPlan, resolution: float, corner: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns of the cells on walls behind which, within a cell, there is free space again."""
    start, way = plan.walls[:, :2], plan.walls[:, 2:] - plan.walls[:, :2]
    length = np.hypot(*way.T)
    count = np.ceil(4 * length / resolution).astype(int)
    wall = np.repeat(np.arange(len(count)), count)
    share = (np.arange(len(wall)) - np.repeat(np.cumsum(count) - count, count) + 0.5) / count[wall]
    points = start[wall] + share[:, None] * way[wall]
    behind = points + resolution * (way[:, ::-1] * (1, -1) / length[:, None])[wall]  # free space is on the left
    thin = shapely.contains_xy(plan.prepared_space(), behind)
    column, row = ((points[thin] - corner) / resolution).astype(int).T
    return row, column


def write_occupancy_grid(grid: OccupancyGrid, path: str | Path) -> None:
    """Write a grid as a map of ``map_server``, mode trinary: a YAML file, and a PGM image of the same name beside it.

    Cells that are neither likely free nor occupied are written as unknown, by ``map_server``'s thresholds.

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
        write_text_atomically(path, yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=120))
    except OSError as error:
        raise FloorPlanError(f"{path}: can't be written: {error.strerror or error}.") from error
