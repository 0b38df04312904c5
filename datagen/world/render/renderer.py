"""Frames of a synthetic drive: the road seen through the same camera model that perception inverts.

Every pixel's ray is found once. For each frame the rays meet the floor; track, clutter and light decide its
colour; walls and things above the floor are painted over; and the sensor makes an image of it.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from datagen.world.render.appearance import Appearance
from datagen.world.render.compiled import COS, HALF_LENGTH, HALF_WIDTH, TILE
from datagen.world.render.floor import FlatThings, Road, Surface, paint_floor
from datagen.world.render.ground import (
    NEAR_CM,
    WALL_CM,
    Canvas,
    Nearby,
    NearestGrid,
    PixelGround,
    View,
    row_poses,
    shake_rotation,
)
from datagen.world.render.light import Lights, mirror_lamps, moved
from datagen.world.render.scene import Scene, build_scene
from datagen.world.render.sensor import Steps, Wander, as_jpeg, corner_falloff, develop, paint_room
from datagen.world.render.solids import SOLID_COLUMNS, paint_solids
from datagen.world.render.textures import PATTERN_BGR, level_starts
from datagen.world.road.track import Track
from lanenet.geometry.camera import Camera
from lanenet.geometry.frames import map_from_car

#: Of tiles and planks; chosen: as wide as tiles are laid.
_JOINT_WIDTH_CM = 0.4
#: Length of the table of noise; frames start anywhere in it, so that no two share their noise.
_NOISE_VALUES = 2**20
#: Periods of the camera's shake: at 20 frames/s from 7 Hz down to 0.7 Hz; chosen: a light car's body.
_SHAKE_FRAMES = (3.0, 30.0)
#: Share of the shake's deviation that is new in every frame; chosen: bumps beside slow nodding.
_JITTER = 0.5


class Renderer:
    """Draws what the camera sees from any pose.

    The same seed gives the same surroundings; what varies from frame to frame depends on the seed and on the
    frame's number only, not on the order in which frames are drawn.
    """

    def __init__(
        self,
        camera: Camera,
        track: Track,
        appearance: Appearance,
        rng: np.random.Generator,
        ground: PixelGround | None = None,
    ) -> None:
        """Prepare the drawing.

        Args:
            camera: The camera on the car.
            track: The road.
            appearance: What the drive looks like.
            rng: Source of randomness for the surroundings and the noise.
            ground: Of the same camera, when another renderer has already found it.
        """
        self.camera, self.track, self.appearance = camera, track, appearance
        scene_rng, noise_rng, drift_rng, shake_rng = rng.spawn(4)
        self._noise_seed = int(noise_rng.integers(2**62))
        # A frame's noise is a section of this, from a random place on: far quicker than fresh numbers.
        noise = noise_rng.standard_normal(_NOISE_VALUES, dtype=np.float32)
        self._noise = np.resize(noise, _NOISE_VALUES + 3 * camera.height * camera.width)
        # Exposure, and the balance of blue and red against green.
        drift_frames = appearance.drift_frames
        self._drift = Wander(3, 0.5 * drift_frames, 3.0 * drift_frames, drift_rng)
        self._steps = Steps(3, drift_frames, drift_rng)
        self._shake = Wander(2, *_SHAKE_FRAMES, shake_rng)
        self._scene = scene = build_scene(track, appearance, scene_rng)
        self._ground = PixelGround.of(camera) if ground is None else ground
        self._canvas = Canvas.of(self._ground)
        self._grid = NearestGrid(track)
        self._road = _road(track, appearance)
        self._surface = _surface(scene, appearance)
        colours = np.minimum(track.boxes[:, HALF_WIDTH + 1 :] * appearance.line_brightness, 255.0)
        boxes = np.column_stack([track.boxes[:, : HALF_WIDTH + 1], colours])
        self._boxes, self._clutter = _nearby(boxes, NEAR_CM), _nearby(scene.clutter, NEAR_CM)
        self._lamps = Nearby(scene.lamps, scene.lamps[:, 2], 2.0 * NEAR_CM)
        self._shadows = _nearby(scene.objects.shadows, NEAR_CM, moving=True)
        self._solids = _nearby(scene.objects.solids, WALL_CM, moving=True)
        self._falloff = corner_falloff(camera.height, camera.width, appearance.vignetting)
        self._eye_car_cm = camera.mounting.position_car_cm
        weights, colours = np.zeros((2, 4 * TILE), np.float32)
        self._room_buffers = (np.zeros(2 * TILE, np.int32), weights, colours)
        self._image = np.zeros((camera.height, camera.width, 3), np.uint8)
        self._blurred = np.zeros((camera.height, camera.width, 3), np.float32)

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
            speed_cm_s: Of the rear axle: with ``exposure_s`` and ``readout_s`` of the appearance it blurs
                and skews.
            yaw_rate_rad_s: Positive left; likewise.

        Returns:
            The image, BGR.
        """
        appearance, height, width = self.appearance, self.camera.height, self.camera.width
        frame_rng = np.random.default_rng((self._noise_seed, frame))
        first = int(frame_rng.integers(_NOISE_VALUES))
        pitch, roll = self._shake_at(frame, frame_rng.standard_normal(2))
        eye_cm = map_from_car(self._eye_car_cm[None, :2], pose, self.camera.wheelbase_cm)[0]
        readout_s = appearance.readout_s
        view = View(
            frame=frame,
            pose=np.array(pose, dtype=np.float64),
            eye_map_cm=np.array([*eye_cm, self._eye_car_cm[2]]),
            shake=shake_rotation(pitch, roll),
            tilt=np.array([-pitch, roll]),
            rows=row_poses(height, float(pose[2]), speed_cm_s, yaw_rate_rad_s, readout_s),
            move_cm=float(speed_cm_s * appearance.exposure_s),
            turn_rad=float(yaw_rate_rad_s * appearance.exposure_s),
            slack_rad=float(0.5 * abs(yaw_rate_rad_s) * readout_s),
        )
        self._paint_floor(view)
        paint_room(self._canvas, self._ground, view, self._scene.room, self._room_buffers)
        self._paint_solids(view)
        light = np.ascontiguousarray(self._canvas.light.reshape(height, -1, 3)[:, :width])
        if appearance.blur_px > 0.0:
            light = cv2.GaussianBlur(light, (0, 0), appearance.blur_px, dst=self._blurred)
        quality = appearance.jpeg_quality
        image = np.empty((height, width, 3), np.uint8) if quality is None else self._image
        noise = self._noise[first : first + image.size]
        gains = self._gains_at(frame)
        develop(light.ravel(), self._falloff, gains, noise, appearance.noise_level, image.ravel())
        return image if quality is None else as_jpeg(image, quality)

    def _paint_floor(self, view: View) -> None:
        """Paint the floor: where the rays meet it, what lies there, and the light on it."""
        appearance, (x, y) = self.appearance, view.pose[:2]
        grid, origin_cm = self._grid.around(view.pose[:2] - 2.0 * NEAR_CM, view.pose[:2] + 2.0 * NEAR_CM)
        shadows = moved(self._shadows.at(x, y)[0], view.frame)[:, :8]
        if appearance.shadow_depth == 0.0:
            shadows = shadows[:0]
        lamps = mirror_lamps(
            self._lamps.at(x, y)[0], view.eye_map_cm, appearance.lamp_level, NEAR_CM, appearance.lamp_streak
        )
        paint_floor(
            self._canvas,
            self._ground,
            view,
            self._surface,
            self._road._replace(grid=grid, grid_origin_cm=origin_cm),
            FlatThings(*self._boxes.at(x, y), *self._clutter.at(x, y)),
            Lights(shadows, lamps, appearance.lamp_edge),
        )

    def _paint_solids(self, view: View) -> None:
        """Paint the things above the floor, the far ones first."""
        near = self._solids.at(view.pose[0], view.pose[1])[0]
        if not len(near):
            return
        solids = moved(near, view.frame)[:, :SOLID_COLUMNS]
        gap = solids[:, :COS] - view.eye_map_cm[:2]
        distance = np.hypot(gap[:, 0], gap[:, 1])
        order = np.argsort(-distance, kind="stable")
        # What stands beyond the walls is not seen.
        reach = np.hypot(solids[order, HALF_LENGTH], solids[order, HALF_WIDTH])
        order = order[distance[order] < WALL_CM + reach]
        solids[:, :COS] -= view.pose[:2]
        paint_solids(self._canvas, self._ground, view, solids[order], self._scene.objects.light)

    def _shake_at(self, frame: int, jitter: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"]:
        """Pitch (down) and roll of the camera at a frame: smooth, and a part that is new every time."""
        unit = np.sqrt(1.0 - _JITTER**2) * self._shake.at(frame) + _JITTER * jitter
        return unit * [self.appearance.shake_pitch_rad, self.appearance.shake_roll_rad]

    def _gains_at(self, frame: int) -> Float[np.ndarray, "3"]:
        """Factor on blue, green and red at a frame."""
        look = self.appearance
        drift, steps = self._drift.at(frame), self._steps.at(frame)
        exposure = look.exposure_drift * drift[0] + look.exposure_step * steps[0]
        blue, red = look.white_balance_drift * drift[1:] + look.white_balance_step * steps[1:]
        return look.exposure * np.asarray(look.white_balance) * np.exp(exposure + np.array([blue, 0.0, red]))


def _road(track: Track, appearance: Appearance) -> Road:
    """The whole road, still without the grid; on a loop each list of sections goes on beyond both ends."""
    heading = track.heading_rad
    nodes = [*track.xy_cm.T, np.cos(heading), np.sin(heading), track.curvature_per_cm, track.s_cm]
    rows, sections = [], [np.empty((0, 2))]
    count = 0
    for marking in track.markings:
        painted = marking.painted_cm
        if track.closed:
            painted = np.concatenate([painted - track.length_cm, painted, painted + track.length_cm])
        colour = np.minimum(np.asarray(marking.colour_bgr) * appearance.line_brightness, 255.0)
        rows.append([marking.offset_cm, marking.width_cm, *colour, count, count + len(painted)])
        sections.append(painted)
        count += len(painted)
    offsets = [marking.offset_cm for marking in track.markings] or [0.5 * track.lane_width_cm]
    return Road(
        grid=np.empty((0, 0), np.int32),
        grid_origin_cm=np.empty(3),
        nodes=np.stack(nodes, axis=1),
        closed=track.closed,
        markings=np.asarray(rows, dtype=np.float64).reshape(-1, 7),
        painted=np.concatenate(sections),
        left_cm=float(max(offsets)),
        right_cm=float(min(offsets) if len(offsets) > 1 else -max(offsets)),
        has_verge=appearance.verge_bgr is not None,
    )


def _surface(scene: Scene, appearance: Appearance) -> Surface:
    return Surface(
        floor_bgr=np.array(appearance.floor_bgr),
        verge_bgr=np.array(appearance.verge_bgr or appearance.floor_bgr),
        pattern_bgr=np.array(PATTERN_BGR[appearance.floor]),
        pattern=scene.texture,
        wear_pattern=scene.wear,
        starts=level_starts(),
        level=appearance.texture_level,
        wear=appearance.line_wear,
        joint_rad=scene.joint_rad,
        joint_shift_cm=scene.joint_shift_cm,
        joint_every_cm=np.array([appearance.joint_u_cm, appearance.joint_v_cm]),
        joint_width_cm=_JOINT_WIDTH_CM,
        joint_level=appearance.joint_level,
    )


def _nearby(rows: Float[np.ndarray, "n k"], sight_cm: float, moving: bool = False) -> Nearby:
    reach = np.hypot(rows[:, HALF_LENGTH], rows[:, HALF_WIDTH])
    if moving:
        reach += np.hypot(rows[:, -4], rows[:, -3])
    return Nearby(rows, reach, sight_cm)
