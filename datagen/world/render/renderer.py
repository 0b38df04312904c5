"""Frames of a synthetic drive: the road seen through the same camera model that perception inverts.

Every pixel's ray is found once. For each frame the rays meet the floor; track, clutter and light answer with
a colour; walls and things above the floor are painted over; and the sensor makes an image of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from datagen.world.render.floor import paint_floor
from datagen.world.render.ground import (
    NEAR_CM,
    NOT_FLOOR,
    TILE,
    WALL_CM,
    PixelGround,
    row_poses,
    shake_rotation,
)
from datagen.world.render.light import mirror_lamps, moved
from datagen.world.render.look import LookSettings
from datagen.world.render.nearest import Nearby, NearestGrid
from datagen.world.render.scene import Scene, Steps, Wander, build_scene
from datagen.world.render.sensor import as_jpeg, corner_falloff, develop, paint_room
from datagen.world.render.solids import SOLID_COLUMNS, paint_solids
from datagen.world.render.textures import PATTERN_BGR, level_starts
from datagen.world.road.track import Track
from lanenet.geometry.camera import Camera
from lanenet.geometry.frames import map_from_car

__all__ = ["PixelGround", "Renderer"]

_JOINT_WIDTH_CM = 0.4
_NOISE_VALUES = 2**20
_SHAKE_FRAMES = (3.0, 30.0)
_JITTER = 0.5  # share of the shake's deviation that is new in every frame


@dataclass(frozen=True, eq=False)
class _View:
    """One frame's view.

    Attributes:
        pose: Rear-axle centre x, y and heading in the middle of the frame's time, frame map.
        frame: Number of the frame.
        eye_map_cm: Optical centre.
        rotation: How the camera shakes, see :func:`datagen.world.render.ground.shake_rotation`.
        rows: Where the car is when each image row is read, see :func:`datagen.world.render.ground.row_poses`.
        way_cm: How far the car drives during the exposure.
        turn_rad: By how much it turns meanwhile.
        slack_rad: By how much it turns, at most, between the middle row and any other.
    """

    pose: Float[np.ndarray, "3"]
    frame: int
    eye_map_cm: Float[np.ndarray, "3"]
    rotation: Float[np.ndarray, "3 3"]
    rows: Float[np.ndarray, "h 4"]
    way_cm: float
    turn_rad: float
    slack_rad: float


class Renderer:
    """Draws what the camera sees from any pose.

    The same seed gives the same surroundings; what varies from frame to frame depends on the seed and on the
    frame's number only, not on the order in which frames are drawn.
    """

    def __init__(
        self,
        camera: Camera,
        track: Track,
        look: LookSettings,
        rng: np.random.Generator,
        ground: PixelGround | None = None,
    ) -> None:
        """Prepare the drawing.

        Args:
            camera: The camera on the car.
            track: The road.
            look: What the drive looks like.
            rng: Source of randomness for the surroundings and the noise.
            ground: Of the same camera, when another renderer has already found it.
        """
        self.camera, self.track, self.look = camera, track, look
        scene_rng, noise_rng, drift_rng, shake_rng = rng.spawn(4)
        self._noise_seed = int(noise_rng.integers(2**62))
        # A frame's noise is a stretch of this, from a random place on: far quicker than fresh numbers.
        noise = noise_rng.standard_normal(_NOISE_VALUES, dtype=np.float32)
        self._noise = np.resize(noise, _NOISE_VALUES + 3 * camera.height * camera.width)
        # Exposure, and the balance of blue and red against green.
        self._drift = Wander(3, 0.5 * look.drift_frames, 3.0 * look.drift_frames, drift_rng)
        self._steps = Steps(3, look.drift_frames, drift_rng)
        self._shake = Wander(2, *_SHAKE_FRAMES, shake_rng)
        self._scene = build_scene(track, look, scene_rng)
        self._ground = PixelGround.of(camera) if ground is None else ground
        self._grid = NearestGrid(track)
        self._road = _road_tables(track, look)
        self._floor_bgr = np.array(
            [*look.floor_bgr, *(look.verge_bgr or look.floor_bgr), *PATTERN_BGR[look.floor]]
        )
        self._patterns = _pattern_tables(self._scene, look)
        boxes = track.boxes
        boxes = np.column_stack([boxes[:, :6], np.minimum(boxes[:, 6:] * look.line_brightness, 255.0)])
        objects = self._scene.objects
        self._boxes, self._clutter = _nearby_things(boxes), _nearby_things(self._scene.clutter)
        self._lamps = Nearby(self._scene.lamps, self._scene.lamps[:, 2], 2.0 * NEAR_CM)
        self._shadows = _nearby_movers(objects.shadows, NEAR_CM)
        self._solids = _nearby_movers(objects.solids, WALL_CM)
        self._falloff = corner_falloff(camera.height, camera.width, look.vignetting)
        self._rays = self._ground.rays.ravel()
        self._eye_car_cm = camera.mounting.position_car_cm
        # Filled anew for each frame; what no ray reaches stays black.
        self._level = np.full(camera.height * self._ground.stride, NOT_FLOOR, np.uint8)
        self._depth = np.zeros(len(self._level), np.float32)
        self._room_buffers = (
            np.zeros(2 * TILE, np.int32),
            np.zeros(4 * TILE, np.float32),
            np.zeros(4 * TILE, np.float32),
        )
        self._image = np.zeros((camera.height, camera.width, 3), np.uint8)
        self._blurred = np.zeros((camera.height, camera.width, 3), np.float32)
        self._light = np.zeros((len(self._level), 3), np.float32)

    def render(
        self,
        pose: Float[np.ndarray, "3"],
        frame: int = 0,
        speed_cm_s: float = 0.0,
        yaw_rate_rad_s: float = 0.0,
    ) -> UInt8[np.ndarray, "h w 3"]:
        """Draw one frame.

        Args:
            pose: Rear-axle centre x, y and heading in the middle of the frame's time, [cm], [cm], [rad],
                frame map.
            frame: Number of the frame, which decides its noise and all that varies with time.
            speed_cm_s: Of the rear axle: with the look's ``exposure_s`` and ``readout_s`` it blurs and skews.
            yaw_rate_rad_s: Positive left; likewise.

        Returns:
            The image, BGR.
        """
        look, height, width = self.look, self.camera.height, self.camera.width
        frame_rng = np.random.default_rng((self._noise_seed, frame))
        first = int(frame_rng.integers(_NOISE_VALUES))
        shake = self._shake_at(frame, frame_rng.standard_normal(2))
        eye_cm = map_from_car(self._eye_car_cm[None, :2], pose, self.camera.wheelbase_cm)[0]
        view = _View(
            pose=pose,
            frame=frame,
            eye_map_cm=np.array([*eye_cm, self._eye_car_cm[2]]),
            rotation=shake_rotation(shake[0], shake[1]),
            rows=row_poses(height, float(pose[2]), speed_cm_s, yaw_rate_rad_s, look.readout_s),
            way_cm=speed_cm_s * look.exposure_s,
            turn_rad=yaw_rate_rad_s * look.exposure_s,
            slack_rad=0.5 * abs(yaw_rate_rad_s) * look.readout_s,
        )
        self._paint_floor(view)
        ground = self._ground
        tilt = np.array([-shake[0], shake[1]])
        paint_room(
            self._light, self._level, ground.azimuth_rad, ground.elevation_rad, ground.toward, float(pose[2]),
            tilt, view.turn_rad, self._scene.room, self._room_buffers,
        )  # fmt: skip
        self._paint_solids(view)
        light = np.ascontiguousarray(self._light.reshape(height, -1, 3)[:, :width])
        if look.blur_px > 0.0:
            light = cv2.GaussianBlur(light, (0, 0), look.blur_px, dst=self._blurred)
        image = np.empty((height, width, 3), np.uint8) if look.jpeg_quality is None else self._image
        gains = self._gains_at(frame)
        noise = self._noise[first : first + image.size]
        develop(light.ravel(), self._falloff, gains, noise, look.noise_level, image.ravel())
        return image if look.jpeg_quality is None else as_jpeg(image, look.jpeg_quality)

    def _paint_floor(self, view: _View) -> None:
        """Paint the floor: where the rays meet it, what lies there, and the light on it."""
        ground, look, x, y = self._ground, self.look, view.pose[0], view.pose[1]
        origin = np.array([x, y])
        grid = self._grid.around(origin - 2.0 * NEAR_CM, origin + 2.0 * NEAR_CM)
        shadows = moved(self._shadows.at(x, y)[0], view.frame)[:, :8]
        if look.shadow_depth == 0.0:
            shadows = shadows[:0]
        lamps = mirror_lamps(
            self._lamps.at(x, y)[0], view.eye_map_cm, look.lamp_level, NEAR_CM, look.lamp_streak
        )
        paint_floor(
            self._light,
            self._level,
            self._rays,
            ground.lowest,
            ground.stride,
            (view.rotation, view.rows, ground.eye_cm, view.way_cm, view.turn_rad),
            origin,
            self._floor_bgr,
            self._patterns,
            (*grid, *self._road),
            (*self._boxes.at(x, y), *self._clutter.at(x, y)),
            (shadows, lamps, look.lamp_edge),
        )

    def _paint_solids(self, view: _View) -> None:
        """Paint the things above the floor, the far ones first."""
        near = self._solids.at(view.pose[0], view.pose[1])[0]
        if not len(near):
            return
        solids = moved(near, view.frame)[:, :SOLID_COLUMNS]
        gap = solids[:, :2] - view.eye_map_cm[:2]
        distance = np.hypot(gap[:, 0], gap[:, 1])
        order = np.argsort(-distance, kind="stable")
        # What stands beyond the walls is not seen.
        order = order[distance[order] < WALL_CM + np.hypot(solids[order, 4], solids[order, 5])]
        solids[:, :2] -= view.pose[:2]
        ground, light = self._ground, self._scene.objects.light
        paint_solids(
            self._light, self._depth, self._rays, ground.stride, ground.width, view.rotation, view.rows,
            ground.eye_cm, view.way_cm, view.turn_rad, view.slack_rad, solids[order], light,
        )  # fmt: skip

    def _shake_at(self, frame: int, jitter: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"]:
        """Pitch (down) and roll of the camera at a frame: smooth, and a part that is new every time."""
        unit = np.sqrt(1.0 - _JITTER**2) * self._shake.at(frame) + _JITTER * jitter
        return unit * [self.look.shake_pitch_rad, self.look.shake_roll_rad]

    def _gains_at(self, frame: int) -> Float[np.ndarray, "3"]:
        """Factor on blue, green and red at a frame."""
        look = self.look
        drift, steps = self._drift.at(frame), self._steps.at(frame)
        exposure = look.exposure_drift * drift[0] + look.exposure_step * steps[0]
        blue, red = look.white_balance_drift * drift[1:] + look.white_balance_step * steps[1:]
        return look.exposure * np.asarray(look.white_balance) * np.exp(exposure + np.array([blue, 0.0, red]))


def _road_tables(track: Track, look: LookSettings) -> tuple[Any, ...]:
    """The road as arrays, see ``paint_floor``; on a loop each list of stretches goes on beyond both ends."""
    heading = track.heading_rad
    nodes = np.stack(
        [*track.xy_cm.T, np.cos(heading), np.sin(heading), track.curvature_per_cm, track.s_cm], axis=1
    )
    rows, stretches = [], [np.empty((0, 2))]
    count = 0
    for marking in track.markings:
        painted = marking.painted_cm
        if track.closed:
            painted = np.concatenate([painted - track.length_cm, painted, painted + track.length_cm])
        colour = np.minimum(np.asarray(marking.colour_bgr) * look.line_brightness, 255.0)
        rows.append([marking.offset_cm, marking.width_cm, *colour, count, count + len(painted)])
        stretches.append(painted)
        count += len(painted)
    markings = np.asarray(rows, dtype=np.float64).reshape(-1, 7)
    offsets = [marking.offset_cm for marking in track.markings] or [0.5 * track.lane_width_cm]
    left = max(offsets)
    right = min(offsets) if len(offsets) > 1 else -left
    borders = np.array([left, right, 0.0 if look.verge_bgr is None else 1.0])
    return nodes, track.closed, markings, np.concatenate(stretches), borders


def _pattern_tables(scene: Scene, look: LookSettings) -> tuple[Any, ...]:
    """The floor's patterns as arrays, see ``paint_floor``."""
    numbers = np.array(
        [
            look.texture_level,
            look.line_wear,
            scene.joint_rad,
            *scene.joint_shift_cm,
            look.joint_u_cm,
            look.joint_v_cm,
            _JOINT_WIDTH_CM,
            look.joint_level,
        ]
    )
    return scene.texture, scene.wear, level_starts(), numbers


def _nearby_things(rows: Float[np.ndarray, "n 9"]) -> Nearby:
    return Nearby(rows, np.hypot(rows[:, 4], rows[:, 5]), NEAR_CM)


def _nearby_movers(rows: Float[np.ndarray, "n k"], sight_cm: float) -> Nearby:
    reach = np.hypot(rows[:, 4], rows[:, 5]) + np.hypot(rows[:, -4], rows[:, -3])
    return Nearby(rows, reach, sight_cm)
