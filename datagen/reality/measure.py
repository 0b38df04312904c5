"""A drive measured by its edge points, in units of the camera's height; needs neither truth nor labels.

The frames go through the same steps as in training. Edge points are chained to runs: neighbours in the image
with the same direction.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from lanenet.data.drives import Drive
from lanenet.errors import DriveFormatError
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.camera import Camera, Mounting
from lanenet.perception.edges.canny import find_edges, to_gray
from lanenet.perception.edges.pixels import EdgePixels
from lanenet.perception.edges.road import PerceptionSettings, RoadEdges, RoadTable
from lanenet.perception.edges.static import find_static, spread_frames

#: Assumed height of every camera: real heights are rarely known, and a frame does not show them.
HEIGHT_CM = 20.0
_PERCEPTION, _WINDOW = PerceptionSettings(), BirdseyeWindow()

#: Distances ahead of the camera's foot, in camera heights: 15, 30 and 60 cm below a camera at 17 cm.
BANDS: tuple[float, ...] = (0.0, 0.9, 1.8, 3.6)
#: Name, unit and meaning of each statistic of a drive.
STATISTICS: dict[str, tuple[str, str]] = {
    "points": ("", "edge points in the network's window, median frame"),
    "points_change": ("%", "their standard deviation from frame to frame, of the mean"),
    "points_near": ("%", "share of the points up to 0.9 camera heights ahead"),
    "points_middle": ("%", "from 0.9 to 1.8"),
    "points_far": ("%", "from 1.8 to 3.6"),
    "long_runs": ("", "long runs per frame"),
    "short_runs": ("", "short runs (clutter) per frame; a small spot's outline makes several"),
    "specks": ("", "short outlines per frame on all of the road that mapping looks at, directions aside"),
    "run_length_px": ("px", "length of the run that the median point is in"),
    "run_length_p90_px": ("px", "the same, 90th percentile"),
    "direction_entropy": (
        "",
        "of the directions on the road, in 10 degree bins; 0: all the same, 1: uniform",
    ),
    "along_share": ("%", "points within 20 degrees of the frame's main direction"),
    "clutter_near": ("%", "points in short runs, of those up to 0.9 camera heights ahead"),
    "clutter_middle": ("%", "from 0.9 to 1.8"),
    "clutter_far": ("%", "from 1.8 to 3.6"),
    "edge_slope": ("/px", "grey levels per pixel across an edge, median"),
    "edge_blur_px": ("px", "standard deviation of the blur that edges show"),
    "brightness": ("", "median grey level of the road"),
    "grain": ("", "standard deviation of the finest pattern and noise, grey levels"),
}
#: Statistics that are the median, or the mean, over a drive's frames.
_MEDIANS = ("direction_entropy", "along_share", "edge_slope", "edge_blur_px", "brightness", "grain")
_MEANS = ("long_runs", "short_runs", "specks")
#: Of directions: 10 degrees each.
_BINS = 18
_ALONG_RAD = np.deg2rad(20.0)
#: Ratio of neighbouring slopes beyond which a blur is too wide to be measured.
_SOFTEST = 0.97

#: Distance of neighbours, at most: a pixel's diagonal, and sub-pixel shifts on either side.
_REACH_PX = 2.0
#: Angle between the directions of neighbours, at most; chosen: a bend passes, a corner does not.
_SAME_DIRECTION = math.cos(math.radians(30.0))
#: A run with fewer points, or shorter on the road, is clutter; chosen: half of a dash.
_LEAST_POINTS = 6
_LEAST_HEIGHTS = 0.5


@dataclass(frozen=True)
class Sampling:
    """How a drive is measured.

    Attributes:
        most: Frames that are measured, evenly over the drive.
        perception: How edges are found.
        window: The network's window.
    """

    most: int
    perception: PerceptionSettings = _PERCEPTION
    window: BirdseyeWindow = _WINDOW


@dataclass(frozen=True, eq=False)
class MeasuredDrive:
    """A drive in numbers.

    Attributes:
        name: Of the drive.
        statistics: See :data:`datagen.reality.measure.STATISTICS`.
        shown: The frame whose number of points is the median one.
        camera: As it was measured, at :data:`HEIGHT_CM`.
        mask: 255 on the car itself; None where it is not in sight.
    """

    name: str
    statistics: dict[str, float]
    shown: UInt8[np.ndarray, "h w *c"]
    camera: Camera
    mask: UInt8[np.ndarray, "h w"] | None


def measure_frames(
    name: str,
    read: Callable[[int], UInt8[np.ndarray, "h w *c"]],
    count: int,
    camera: Camera,
    sampling: Sampling,
) -> MeasuredDrive:
    """Measure a drive.

    Args:
        name: Of the drive.
        read: Returns the image of a frame by its place in the drive.
        count: Frames of the drive.
        camera: Its camera; only the direction in which it looks and the lens matter.
        sampling: How to measure it.

    Raises:
        CalibrationError: If the camera sees no road.
        DriveFormatError: If a frame cannot be read.
    """
    camera = at_nominal_height(camera)
    mask = _car_mask(read, count)
    table = RoadTable(camera, sampling.perception.range, mask)
    rows = np.unique(np.linspace(0, count - 1, min(sampling.most, count)).round().astype(int))
    figures = [
        edge_statistics(read(i), table, HEIGHT_CM, sampling.perception, sampling.window)
        for i in rows.tolist()
    ]
    points = [frame.points for frame in figures]
    middle = int(rows[np.argsort(points, kind="stable")[len(points) // 2]])
    return MeasuredDrive(name, drive_statistics(figures), read(middle), camera, mask)


def measure_drive(drive: Drive, camera: Camera, sampling: Sampling) -> MeasuredDrive:
    """Measure a recorded drive, see :func:`measure_frames`.

    Raises:
        DriveFormatError: If its images are not of the camera's size, or cannot be read.
    """
    if (drive.width, drive.height) != (camera.width, camera.height):
        raise DriveFormatError(
            f"{drive.path}: images of {drive.width}x{drive.height} px, but its camera is calibrated for "
            f"{camera.width}x{camera.height}"
        )
    return measure_frames(drive.name, drive.image, len(drive), camera, sampling)


def at_nominal_height(camera: Camera) -> Camera:
    """Return the camera at :data:`HEIGHT_CM`, with the origin of the car's frame below it."""
    old = camera.mounting
    return replace(camera, mounting=Mounting(HEIGHT_CM, old.pitch_down_rad, old.roll_rad, old.yaw_rad))


def _car_mask(
    read: Callable[[int], UInt8[np.ndarray, "h w *c"]], count: int
) -> UInt8[np.ndarray, "h w"] | None:
    """Find the car's own parts, as mapping does."""
    try:
        part = find_static(read(i) for i in spread_frames(count))
    except DriveFormatError:  # too few frames of a moving car
        return None
    return part.mask if part.rows and not part.is_too_high else None


@dataclass(frozen=True, eq=False)
class FrameFigures:
    """What one frame adds to a drive's statistics.

    Attributes:
        points: Points in the window.
        by_band: Points by distance, see :data:`BANDS`.
        clutter_by_band: Those of them in short runs.
        long_runs: Number of long runs.
        short_runs: Number of short runs.
        specks: Number of short outlines, directions aside, beyond the window too.
        run_lengths_px: For each point the points of its run.
        direction_entropy: 0..1; NaN without points.
        along_share: 0..1; NaN without points.
        edge_slope: NaN without points.
        edge_blur_px: NaN without points.
        brightness: Median grey level of the road in sight.
        grain: Standard deviation of the finest pattern.
    """

    points: int
    by_band: Float[np.ndarray, "bands"]
    clutter_by_band: Float[np.ndarray, "bands"]
    long_runs: int
    short_runs: int
    specks: int
    run_lengths_px: Float[np.ndarray, "_"]
    direction_entropy: float
    along_share: float
    edge_slope: float
    edge_blur_px: float
    brightness: float
    grain: float


def edge_statistics(
    frame_bgr: UInt8[np.ndarray, "h w *c"],
    table: RoadTable,
    camera_height_cm: float,
    settings: PerceptionSettings = _PERCEPTION,
    window: BirdseyeWindow = _WINDOW,
) -> FrameFigures:
    """Measure one frame by the edge points that a network gets of it.

    Args:
        frame_bgr: The frame.
        table: From its pixels to the road.
        camera_height_cm: Of the camera that the table was made for; the unit of distances.
        settings: How edges are found.
        window: The network's window, with its origin below the camera.
    """
    gray = to_gray(frame_bgr)
    pixels = find_edges(frame_bgr, settings.edges, table.keep, table.scale)
    road = table.lift(pixels)
    outlines = chain_points(pixels.uv_px, pixels.normals, road.points_cm, round_corners=True)
    inside = _inside(road.points_cm, window)
    pixels = EdgePixels(pixels.uv_px[inside], pixels.normals[inside])
    road = RoadEdges(road.points_cm[inside], road.normals[inside])
    runs = chain_points(pixels.uv_px, pixels.normals, road.points_cm)
    short = runs.are_short(camera_height_cm)
    ahead = road.points_cm[:, 1] / camera_height_cm
    bands = np.array(BANDS)
    entropy, along = _directions(road.normals)
    step, blur = _edge_profile(gray, pixels)
    on_road = table.keep > 0
    fine = gray.astype(np.float32) - cv2.GaussianBlur(gray.astype(np.float32), (3, 3), 0)
    return FrameFigures(
        points=len(ahead),
        by_band=np.histogram(ahead, bands)[0].astype(np.float64),
        clutter_by_band=np.histogram(ahead[short[runs.of_point]], bands)[0].astype(np.float64),
        long_runs=int(np.count_nonzero(~short)),
        short_runs=int(np.count_nonzero(short)),
        specks=int(np.count_nonzero(outlines.are_short(camera_height_cm))),
        run_lengths_px=runs.points[runs.of_point].astype(np.float64),
        direction_entropy=entropy,
        along_share=along,
        edge_slope=step,
        edge_blur_px=blur,
        brightness=float(np.median(gray[on_road])),
        grain=_grain(np.abs(fine[on_road])),
    )


def drive_statistics(frames: Sequence[FrameFigures]) -> dict[str, float]:
    """Sum up a drive: one number for each of :data:`STATISTICS`.

    Shares and lengths of runs are over all points of the drive; counts of runs are means over the frames, all
    others medians.

    Returns:
        NaN where no frame has a point.
    """
    points = np.array([frame.points for frame in frames], dtype=np.float64)
    by_band = np.sum([frame.by_band for frame in frames], axis=0)
    clutter = np.sum([frame.clutter_by_band for frame in frames], axis=0)
    lengths = np.concatenate([frame.run_lengths_px for frame in frames])
    with np.errstate(invalid="ignore", divide="ignore"):
        shares = 100.0 * by_band / by_band.sum()
        clutter_shares = 100.0 * clutter / by_band
        change = 100.0 * points.std() / points.mean()
    run_px, run_p90_px = np.quantile(lengths, [0.5, 0.9]) if lengths.size else (np.nan, np.nan)
    values = {
        "points": np.median(points),
        "points_change": change,
        **dict(zip(("points_near", "points_middle", "points_far"), shares, strict=True)),
        **{name: np.mean([getattr(frame, name) for frame in frames]) for name in _MEANS},
        "run_length_px": run_px,
        "run_length_p90_px": run_p90_px,
        **dict(zip(("clutter_near", "clutter_middle", "clutter_far"), clutter_shares, strict=True)),
        **{name: _known_median([getattr(frame, name) for frame in frames]) for name in _MEDIANS},
    }
    values["along_share"] *= 100.0
    return {name: float(values[name]) for name in STATISTICS}


def _grain(deviations: Float[np.ndarray, "n"]) -> float:
    """Standard deviation from the smallest three quarters: markings and other edges do not count."""
    smallest = np.sort(deviations)[: max(1, 3 * len(deviations) // 4)]
    # 0.5147: the same mean of standard normal numbers.
    return float(smallest.mean() / 0.5147)


def _known_median(values: Sequence[float]) -> float:
    known = [value for value in values if np.isfinite(value)]
    return float(np.median(known)) if known else float("nan")


def _inside(points_cm: Float[np.ndarray, "n 2"], window: BirdseyeWindow) -> Bool[np.ndarray, "n"]:
    x, y = points_cm.T
    with np.errstate(invalid="ignore"):
        return (x >= window.left_cm) & (x < window.right_cm) & (y > window.near_cm) & (y <= window.far_cm)


def _directions(normals: Float[np.ndarray, "n 2"]) -> tuple[float, float]:
    """Entropy of the directions, and the share near the main one: the fullest 40 degrees."""
    if not len(normals):
        return float("nan"), float("nan")
    # Both edges of a line run the same way: angles modulo half a turn.
    angle = np.arctan2(normals[:, 1], normals[:, 0]) % np.pi
    share = np.histogram(angle, _BINS, (0.0, np.pi))[0] / len(angle)
    filled = share[share > 0.0]
    entropy = float(-(filled * np.log(filled)).sum() / np.log(_BINS))
    doubled = np.exp(2j * angle)
    best = 0
    for middle in np.linspace(0.0, np.pi, 2 * _BINS, endpoint=False):
        off = np.abs(np.angle(doubled * np.exp(-2j * middle)))
        best = max(best, int(np.count_nonzero(off <= 2.0 * _ALONG_RAD)))
    return entropy + 0.0, best / len(angle)


def _edge_profile(gray: UInt8[np.ndarray, "h w"], pixels: EdgePixels) -> tuple[float, float]:
    """Slope at the edges, and the blur that follows from the ratio of neighbouring slopes.

    Source:
        The slopes of a step blurred by a Gaussian are a Gaussian: one pixel off they are the middle one
        times exp(-1 / (2 sigma^2)). Checked in ``tests/unit/reality/test_reality_statistics.py``.
    """
    if not len(pixels.uv_px):
        return float("nan"), float("nan")
    offsets = np.array([-1.5, -0.5, 0.5, 1.5])
    at = pixels.uv_px[:, None, :] + offsets[None, :, None] * pixels.normals[:, None, :]
    u, v = at[..., 0].astype(np.float32), at[..., 1].astype(np.float32)
    levels = cv2.remap(gray.astype(np.float32), u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    before, middle, after = np.diff(levels.astype(np.float64).reshape(-1, 4), axis=1).T
    good = middle > 1.0
    if not good.any():
        return float("nan"), float("nan")
    ratio = float(np.median(0.5 * (before[good] + after[good]) / middle[good]))
    ratio = min(max(ratio, 1e-3), _SOFTEST)
    return float(np.median(middle[good])), float(np.sqrt(-0.5 / np.log(ratio)))


@dataclass(frozen=True, eq=False)
class Runs:
    """Runs of the edge points of one frame.

    Attributes:
        of_point: Number of each point's run.
        points: Points of each run, about its length in pixels.
        extent_cm: Diagonal of the box that holds each run on the road.
    """

    of_point: Int[np.ndarray, "n"]
    points: Int[np.ndarray, "k"]
    extent_cm: Float[np.ndarray, "k"]

    def are_short(self, camera_height_cm: float) -> Bool[np.ndarray, "k"]:
        """Return which runs are too short to be distinguished from clutter.

        These are shorter than half a camera height on the road, or of fewer than six points. Ends of dashes
        are among them, on real roads as on synthetic ones.
        """
        return (self.points < _LEAST_POINTS) | (self.extent_cm < _LEAST_HEIGHTS * camera_height_cm)


def chain_points(
    uv_px: Float[np.ndarray, "n 2"],
    normals: Float[np.ndarray, "n 2"],
    road_cm: Float[np.ndarray, "n 2"],
    round_corners: bool = False,
) -> Runs:
    """Chain edge points to runs.

    Two points are neighbours if they are within two pixels and their directions within 30 degrees. A run
    ends at a corner, and the two edges of a thin line are two runs.

    Args:
        uv_px: Positions, frame image.
        normals: Unit gradients, image axes.
        road_cm: The same points on the road.
        round_corners: Ignore the directions, so that an outline is one run.
    """
    n = len(uv_px)
    if n == 0:
        return Runs(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))
    pairs = cKDTree(uv_px).query_pairs(_REACH_PX, output_type="ndarray")
    if not round_corners:
        pairs = pairs[np.einsum("ij,ij->i", normals[pairs[:, 0]], normals[pairs[:, 1]]) > _SAME_DIRECTION]
    a, b = pairs.T
    count, of_point = connected_components(coo_array((np.ones(len(a)), (a, b)), shape=(n, n)), directed=False)
    order = np.argsort(of_point, kind="stable")
    starts = np.searchsorted(of_point[order], np.arange(count))
    sides = np.maximum.reduceat(road_cm[order], starts) - np.minimum.reduceat(road_cm[order], starts)
    return Runs(
        of_point.astype(np.int64),
        np.bincount(of_point, minlength=count).astype(np.int64),
        np.hypot(sides[:, 0], sides[:, 1]).astype(np.float64),
    )
