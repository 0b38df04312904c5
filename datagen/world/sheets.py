"""Sheets of sample frames: every preset in random appearances, every group of effects on several roads.

A sheet of a preset shows each frame with the true lines of the driven lane, beside the bird's-eye edges that
perception finds in it. A sheet of effects shows one place per road, without and with each effect; no lines
are drawn over it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from datagen.world.car.camera import CameraSettings
from datagen.world.render.appearance import Appearance
from datagen.world.render.ground import PixelGround
from datagen.world.render.renderer import Renderer
from datagen.world.road.build import random_track
from datagen.world.road.furniture import FurnitureRates
from datagen.world.road.track import Track
from datagen.world.road.track_picture import FIXED_BITS
from datagen.world.road.track_settings import TrackSettings, preset, preset_names
from datagen.world.world import SimulationSettings, assemble_world, resolve_length
from lanenet.config import check_settings
from lanenet.errors import ConfigError
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.camera import Camera
from lanenet.perception.edges.road import PerceptionSettings, RoadEdgeExtractor

Bgr = tuple[int, int, int]
Image = UInt8[np.ndarray, "_ _ 3"]

_SPEED_CM_S = 60.0
#: From the front axle to the thing that a frame shows; and from the middle of the lane to the car.
_BEFORE_CM, _BESIDE_CM = 45.0, 2.0
_TRUTH_BGR: tuple[Bgr, Bgr] = ((255, 200, 0), (60, 60, 255))  # left, right
_TEXT_BGR, _PAPER = (30, 30, 30), 245
_GAP_PX, _TITLE_PX = 4, 18
_ROAD_COLUMNS, _ROAD_ROWS = 2, 4
#: Qualities of the JPEG files that are tried, and the factor on their size where all are too large.
_QUALITIES, _SHRINK = (90, 80, 70, 60, 50, 42), 0.88


@dataclass(frozen=True)
class Effect:
    """What one column of a sheet switches on.

    Attributes:
        name: Its title.
        look: Keys of :class:`Appearance`.
        furniture_per_m: Rate of each kind of furniture; 0: none.
        frame: Number of the frame, for what varies with time.
        speed: Factor on speed and yaw rate.
    """

    name: str
    look: dict[str, Any] = field(default_factory=dict)
    furniture_per_m: float = 0.0
    frame: int = 7
    speed: float = 1.0


_DULL: dict[str, Any] = {"texture_level": 2.0, "wall_level": 25.0}
_LAMPS: dict[str, Any] = {"lamps_per_m": 0.7, "lamp_level": 150.0}
_THINGS: dict[str, Any] = {"objects_per_m": 3.0, "objects_on_road": 0.0, "shadow_depth": 0.45}
_SHAKE: dict[str, Any] = {"shake_pitch_rad": 0.02, "shake_roll_rad": 0.02}
_WOOD: dict[str, Any] = {
    "texture_level": 7.0, "texture_scale_cm": 0.5, "texture_stretch": 12.0, "floor_bgr": (70, 100, 135)
}  # fmt: skip


def _floor(kind: str, **more: Any) -> Effect:
    return Effect(kind, {"floor": kind, **more})


#: Sheets of effects: the roads of the rows, and the columns; the first column is the road without them.
EFFECT_SHEETS: dict[str, tuple[tuple[str, ...], tuple[Effect, ...]]] = {
    "floors": (
        ("paper", "carolo_cup", "donkey_tape"),
        (
            Effect("plain", {"texture_level": 0.0}),
            _floor("asphalt", texture_level=9.0, texture_scale_cm=0.4, floor_bgr=(58, 56, 55)),
            _floor("wood", **_WOOD),
            _floor("tile", texture_level=3.0, joint_u_cm=40.0, joint_v_cm=40.0, floor_bgr=(135, 130, 130)),
            _floor("carpet", texture_level=7.0, texture_scale_cm=0.4, floor_bgr=(95, 70, 60)),
            _floor("mat", texture_level=4.0, floor_bgr=(80, 80, 80), verge_bgr=(70, 120, 60)),
            _floor("grass", texture_level=10.0, texture_scale_cm=0.4, floor_bgr=(45, 90, 62)),
        ),
    ),
    "light": (
        ("garage", "bfmc", "duckietown"),
        (
            Effect("even light"),
            Effect("lamps", _LAMPS),
            Effect("lamps, hard and long", {**_LAMPS, "lamp_streak": 2.0, "lamp_edge": 5.0}),
            Effect("shadows", {"shadows_per_m": 2.5, "shadow_depth": 0.5}),
            Effect("dark", {"exposure": 0.55}),
            Effect("bright", {"exposure": 1.35}),
            Effect("white balance", {"white_balance": (0.85, 1.0, 1.18)}),
        ),
    ),
    "motion": (
        ("paper", "bfmc", "mat"),
        (
            Effect("at rest", speed=0.0),
            Effect("exposed for 25 ms", {"exposure_s": 0.025}, speed=2.0),
            Effect("read out in 30 ms", {"readout_s": 0.03}, speed=2.0),
            Effect("shake, frame 7", _SHAKE),
            Effect("shake, frame 9", _SHAKE, frame=9),
        ),
    ),
    "things": (
        ("carolo_cup", "bfmc", "donkey_tape"),
        (
            Effect("lines only"),
            Effect("furniture", furniture_per_m=0.5),
            Effect("clutter", {"clutter_per_m": 6.0}),
            Effect("things beside the road", _THINGS),
            Effect("things partly on it", {**_THINGS, "objects_on_road": 1.0}),
            Effect("all, with shadows", {**_THINGS, "clutter_per_m": 3.0, "shadows_per_m": 0.6}, 0.5),
        ),
    ),
    "sensor": (
        ("duckietown", "garage", "paper"),
        (
            Effect("ideal"),
            Effect("vignetting", {"vignetting": 0.5}),
            Effect("blur of 1.2 px", {"blur_px": 1.2}),
            Effect("noise of 7", {"noise_level": 7.0}),
            Effect("JPEG, quality 40", {"jpeg_quality": 40}),
            Effect("all", {"vignetting": 0.5, "blur_px": 1.0, "noise_level": 5.0, "jpeg_quality": 60}),
        ),
    ),
}


def sheet_names() -> list[str]:
    """Names of all sheets: the presets, then the groups of effects."""
    return [*preset_names(), *EFFECT_SHEETS]


def draw_sheet(name: str) -> Image:
    """Draw a sheet; the same name gives the same picture.

    Args:
        name: One of :func:`sheet_names`.

    Raises:
        ConfigError: If there is no such sheet.
    """
    if name in EFFECT_SHEETS:
        return _effect_sheet(name)
    if name in preset_names():
        return _road_sheet(name)
    raise ConfigError(f"no sheet {name!r}, expected one of {', '.join(sheet_names())}")


def encode_sheet(sheet: Image, max_bytes: int | None = None) -> bytes:
    """Return a sheet as JPEG; to fit, its quality is lowered first, then its size."""
    while True:
        for quality in _QUALITIES:
            _, data = cv2.imencode(".jpg", sheet, [cv2.IMWRITE_JPEG_QUALITY, quality])
            if max_bytes is None or data.size <= max_bytes or min(sheet.shape[:2]) < 50:
                return bytes(data)
        sheet = np.asarray(cv2.resize(sheet, None, fx=_SHRINK, fy=_SHRINK, interpolation=cv2.INTER_AREA))


def _road_sheet(name: str) -> Image:
    """A preset in several appearances: frame with the true lines, and the edges from above."""
    total = _ROAD_COLUMNS * _ROAD_ROWS
    # Its own seeds, so that no two presets look the same.
    first = total * preset_names().index(name)
    tiles: list[Image] = []
    for seed in range(first, first + total):
        world = assemble_world(resolve_length(SimulationSettings(seed=seed, track=preset(name))))
        # Every other frame faces something that is painted on the road, if there is anything.
        s_cm = _place(world.track, np.random.default_rng([seed, 1]), facing=seed % 2 == 0)
        pose, yaw_rate = _pose_at(world.track, s_cm, world.camera)
        frame = world.renderer.render(pose, seed, _SPEED_CM_S, yaw_rate)
        lines_cm = world.track.lines_car(pose, world.camera.wheelbase_cm)
        above = _from_above(frame, world.camera, lines_cm)
        for line_cm, colour in zip(lines_cm, _TRUTH_BGR, strict=True):
            _draw_line(frame, world.camera.project_ground(line_cm), colour)
        title = f"{name}, seed {seed}, {world.settings.look.floor}, at {s_cm:.0f} cm"
        tiles.append(_titled(np.concatenate([frame, above], axis=1), title))
    return _grid(tiles, _ROAD_COLUMNS)


def _effect_sheet(name: str) -> Image:
    """A row per road, a column per effect, all of a row at one place."""
    roads, effects = EFFECT_SHEETS[name]
    camera = CameraSettings().build(SimulationSettings().car.wheelbase_cm)
    ground = PixelGround.of(camera)
    tiles: list[Image] = []
    for row, road in enumerate(roads):
        settings = preset(road)
        tracks = {
            rate: random_track(_with_furniture(settings, rate), np.random.default_rng(row))
            for rate in {effect.furniture_per_m for effect in effects}
        }
        # The road with most furniture decides the place; furniture does not move the road.
        s_cm = _place(tracks[max(tracks)], np.random.default_rng([row, 2]), facing=True)
        for effect in effects:
            track = tracks[effect.furniture_per_m]
            floor = {} if settings.floor_bgr is None else {"floor_bgr": settings.floor_bgr}
            look = check_settings(Appearance, {**_DULL, **floor, **effect.look}, effect.name)
            renderer = Renderer(camera, track, look, np.random.default_rng(row), ground)
            pose, yaw_rate = _pose_at(track, s_cm, camera)
            frame = renderer.render(pose, effect.frame, _SPEED_CM_S * effect.speed, yaw_rate * effect.speed)
            tiles.append(_titled(frame, f"{road}: {effect.name}"))
    return _grid(tiles, len(effects))


def _with_furniture(settings: TrackSettings, per_m: float) -> TrackSettings:
    kinds = [name for name in FurnitureRates.model_fields if name.endswith("_per_m")]
    rates = settings.random_furniture.model_copy(update=dict.fromkeys(kinds, per_m))
    return settings.model_copy(update={"random_furniture": rates})


def _place(track: Track, rng: np.random.Generator, facing: bool) -> float:
    """A place on the road; if ``facing``, before something that is painted on the road, if there is any."""
    share, choice = rng.random(2)
    s_cm = share * track.length_cm
    if not facing or not len(track.boxes):
        return float(s_cm)
    box = track.boxes[int(choice * len(track.boxes))]
    return track.nearest(box[:2])[0] - _BEFORE_CM


def _pose_at(track: Track, s_cm: float, camera: Camera) -> tuple[Float[np.ndarray, "3"], float]:
    """Pose of the car whose front axle is there, a little beside the middle, and its yaw rate."""
    rear_cm, heading = track.point(s_cm - camera.wheelbase_cm, _BESIDE_CM)
    return np.array([*rear_cm, heading]), _SPEED_CM_S * float(track.curvature(np.array([s_cm]))[0])


def _from_above(
    frame_bgr: Image, camera: Camera, lines_cm: tuple[Float[np.ndarray, "_ 2"], Float[np.ndarray, "_ 2"]]
) -> Image:
    """The edges that the network would see, and the true lines, as large as the frame."""
    window = BirdseyeWindow()
    edges = RoadEdgeExtractor(camera, PerceptionSettings()).extract(frame_bgr)
    raster = 255 - window.rasterise(edges.points_cm)
    height, width = frame_bgr.shape[:2]
    above = cv2.resize(raster, (width, height), interpolation=cv2.INTER_NEAREST)
    above = np.asarray(cv2.cvtColor(above, cv2.COLOR_GRAY2BGR))
    scale = np.array([width / window.columns, height / window.rows])
    for line_cm, colour in zip(lines_cm, _TRUTH_BGR, strict=True):
        _draw_line(above, (window.cells(line_cm)[:, ::-1] + 0.5) * scale - 0.5, colour)
    return above


def _draw_line(image: Image, points_px: Float[np.ndarray, "n 2"], colour: Bgr) -> None:
    """Draw a thin line between the points that lie in the image or near it."""
    limit = 2.0 * max(image.shape)
    with np.errstate(invalid="ignore"):
        seen = (np.abs(points_px) < limit).all(axis=1)
    fixed = np.rint(np.where(seen[:, None], points_px, 0.0) * 2**FIXED_BITS).astype(np.int32)
    for k in np.flatnonzero(seen[:-1] & seen[1:]):
        cv2.line(image, fixed[k].tolist(), fixed[k + 1].tolist(), colour, 1, cv2.LINE_AA, FIXED_BITS)


def _titled(tile: Image, title: str) -> Image:
    bar = np.full((_TITLE_PX, tile.shape[1], 3), _PAPER, np.uint8)
    cv2.putText(bar, title, (4, 13), cv2.FONT_HERSHEY_SIMPLEX, 0.42, _TEXT_BGR, 1, cv2.LINE_AA)
    return np.concatenate([bar, tile], axis=0)


def _grid(tiles: list[Image], columns: int) -> Image:
    gap = ((0, _GAP_PX), (0, _GAP_PX), (0, 0))
    padded = [np.pad(tile, gap, constant_values=_PAPER) for tile in tiles]
    rows = [np.concatenate(padded[i : i + columns], axis=1) for i in range(0, len(tiles), columns)]
    return np.concatenate(rows)[:-_GAP_PX, :-_GAP_PX]
