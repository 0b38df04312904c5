"""Frames of a synthetic drive: the road seen through the same camera model that perception inverts.

Every pixel's point of the road and the patch of road that it covers are found once; for each frame they are
moved to the map, where track, clutter and lamps answer with a colour.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int, UInt8

from datagen.world.kernels import develop, paint_floor, paint_room
from datagen.world.look import LookSettings
from datagen.world.nearest_grid import nearest_sample_grid
from datagen.world.scene import TEXTURE_CELL_CM, build_scene
from datagen.world.track import Track
from lanenet.geometry.camera import Camera
from lanenet.geometry.frames import car_from_map, map_from_car

_NEAR_CM = 250.0  # markings and clutter are painted up to here
_WALL_CM = 450.0  # the floor ends here
_JOINT_WIDTH_CM = 0.4
_NOISE_VALUES = 2**20


@dataclass(frozen=True, eq=False)
class PixelGround:
    """What each pixel of a camera sees, found once and shared by all drives with that camera.

    Attributes:
        floor: Flat index of the pixels that see the floor, the near ones first.
        n_near: How many are near.
        near_box_cm: Left, rear, right and front of the near points.
        points_cm: Their points of the road, right and ahead of the **rear** axle.
        jacobian_cm: d(right, ahead)/d(u, v), [cm/px], as four columns.
        level: Level of the floor's texture for each.
        room: Flat index of the pixels that see the room.
        azimuth_rad: Of their rays, from straight ahead, left positive.
        elevation_rad: Of their rays, from the foot of the wall.
    """

    floor: Int[np.ndarray, "f"]
    n_near: int
    near_box_cm: tuple[float, float, float, float]
    points_cm: Float[np.ndarray, "f 2"]
    jacobian_cm: Float[np.ndarray, "f 4"]
    level: Int[np.ndarray, "f"]
    room: Int[np.ndarray, "r"]
    azimuth_rad: Float[np.ndarray, "r"]
    elevation_rad: Float[np.ndarray, "r"]

    @classmethod
    def of(cls, camera: Camera) -> PixelGround:
        """Cast every pixel's ray."""
        height, width = camera.height, camera.width
        v, u = np.mgrid[0:height, 0:width].astype(np.float64)
        centre = camera.intersect_ground(np.stack([u.ravel(), v.ravel()], axis=1))
        v, u = np.mgrid[0 : height + 1, 0 : width + 1] - 0.5
        corner = camera.intersect_ground(np.stack([u.ravel(), v.ravel()], axis=1)).reshape(*u.shape, 2)
        # The patch that a pixel covers runs between its own corners.
        du = 0.5 * (corner[:-1, 1:] + corner[1:, 1:] - corner[:-1, :-1] - corner[1:, :-1]).reshape(-1, 2)
        dv = 0.5 * (corner[1:, :-1] + corner[1:, 1:] - corner[:-1, :-1] - corner[:-1, 1:]).reshape(-1, 2)
        distance = np.linalg.norm(centre - camera.mounting.position_car_cm[:2], axis=1)
        with np.errstate(invalid="ignore"):
            sees_floor = (distance < _WALL_CM) & np.isfinite(du + dv).all(axis=1)
            near = np.flatnonzero(sees_floor & (distance < _NEAR_CM))
            floor = np.concatenate([near, np.flatnonzero(sees_floor & ~(distance < _NEAR_CM))])
        points = centre[floor] + [0.0, camera.wheelbase_cm]
        seen = points[: len(near)] if len(near) else np.full((1, 2), np.nan)
        box = np.concatenate([seen.min(axis=0), seen.max(axis=0)])
        size_cm = np.sqrt(np.abs(du[floor, 0] * dv[floor, 1] - du[floor, 1] * dv[floor, 0]))
        level = np.clip(np.rint(np.log2(size_cm / TEXTURE_CELL_CM) + 0.5), 0, 5).astype(np.intp)
        v, u = np.mgrid[0:height, 0:width].astype(np.float64)
        rays = camera.unproject(np.stack([u.ravel(), v.ravel()], axis=1)) @ camera.mounting.camera_from_car
        room = np.flatnonzero(~sees_floor & np.isfinite(rays).all(axis=1))
        foot_rad = np.arctan2(camera.mounting.height_cm, _WALL_CM)
        elevation = np.arcsin(np.clip(rays[room, 2], -1.0, 1.0)) + foot_rad
        return cls(
            floor=floor,
            n_near=len(near),
            near_box_cm=(float(box[0]), float(box[1]), float(box[2]), float(box[3])),
            points_cm=points,
            jacobian_cm=np.stack([du[floor, 0], dv[floor, 0], du[floor, 1], dv[floor, 1]], axis=1),
            level=level,
            room=room,
            azimuth_rad=np.arctan2(-rays[room, 0], rays[room, 1]),
            elevation_rad=np.maximum(elevation, 0.0),
        )


class Renderer:
    """Draws what the camera sees from any pose.

    The same seed gives the same surroundings; a frame's noise depends on the seed and on the frame's number
    only, not on the order in which frames are drawn.
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
        scene_rng, noise_rng = rng.spawn(2)
        self._noise_seed = int(noise_rng.integers(2**62))
        # A frame's noise is a stretch of this, from a random place on: far quicker than fresh numbers.
        self._noise = noise_rng.standard_normal(_NOISE_VALUES, dtype=np.float32)
        self._scene = build_scene(track, look, scene_rng)
        self._ground = PixelGround.of(camera) if ground is None else ground
        self._nodes = np.stack(
            [
                track.xy_cm[:, 0],
                track.xy_cm[:, 1],
                np.cos(track.heading_rad),
                np.sin(track.heading_rad),
                track.curvature_per_cm,
                track.s_cm,
            ],
            axis=1,
        )
        self._grid, self._grid_frame = nearest_sample_grid(track)
        self._markings, self._stretches = _marking_tables(track, look.line_brightness)
        scene = self._scene
        self._joints = np.array(
            [
                scene.joint_rad,
                *scene.joint_shift_cm,
                look.joint_u_cm,
                look.joint_v_cm,
                _JOINT_WIDTH_CM,
                look.joint_level,
            ]
        )
        self._gains = _gains(camera, look)
        # Filled anew for each frame; what no ray reaches stays black.
        self._light = np.zeros((camera.height * camera.width, 3), np.float32)

    def render(self, pose: Float[np.ndarray, "3"], frame: int = 0) -> UInt8[np.ndarray, "h w 3"]:
        """Draw one frame.

        Args:
            pose: Rear-axle centre x, y and heading, [cm], [cm], [rad], frame map.
            frame: Number of the frame, which decides its noise.

        Returns:
            The image, BGR.
        """
        look, ground, scene = self.look, self._ground, self._scene
        paint_floor(
            self._light,
            ground.floor,
            ground.points_cm,
            ground.jacobian_cm,
            ground.level,
            ground.n_near,
            pose,
            np.asarray(look.floor_bgr),
            scene.texture,
            TEXTURE_CELL_CM,
            look.texture_level,
            self._joints,
            self._grid,
            self._grid_frame,
            self._nodes,
            self.track.closed,
            self._markings,
            self._stretches,
            look.line_wear,
            self._clutter_near(pose),
            self._mirrored_lamps(pose),
        )
        paint_room(
            self._light, ground.room, ground.azimuth_rad, ground.elevation_rad, float(pose[2]), scene.room
        )
        light = self._light.reshape(self.camera.height, self.camera.width, 3)
        if look.blur_px > 0.0:
            light = cv2.GaussianBlur(light, (0, 0), look.blur_px)
        first = int(np.random.default_rng((self._noise_seed, frame)).integers(_NOISE_VALUES))
        image = np.empty_like(light, dtype=np.uint8)
        develop(light.reshape(-1, 3), self._gains, self._noise, first, look.noise_level, image.reshape(-1, 3))
        if look.jpeg_quality is not None:
            _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, look.jpeg_quality])
            image = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR))
        return image

    def _clutter_near(self, pose: Float[np.ndarray, "3"]) -> Float[np.ndarray, "n 9"]:
        """Clutter within the box of road that the camera sees."""
        clutter = self._scene.clutter
        reach = clutter[:, 4] + clutter[:, 5]
        right, ahead = car_from_map(clutter[:, :2], pose, 0.0).T
        left_cm, rear_cm, right_cm, front_cm = self._ground.near_box_cm
        seen = (right + reach > left_cm) & (right - reach < right_cm)
        return clutter[seen & (ahead + reach > rear_cm) & (ahead - reach < front_cm)]

    def _mirrored_lamps(self, pose: Float[np.ndarray, "3"]) -> Float[np.ndarray, "n 8"]:
        """Where the floor mirrors the lamps into the camera: they wander along as it moves."""
        lamps, mounting = self._scene.lamps, self.camera.mounting
        eye = map_from_car(mounting.position_car_cm[None, :2], pose, self.camera.wheelbase_cm)[0]
        share = mounting.height_cm / (mounting.height_cm + lamps[:, 2])
        towards = (lamps[:, :2] - eye) * share[:, None]
        distance = np.linalg.norm(towards, axis=1)
        near = distance < _NEAR_CM
        towards, distance, size_rad = towards[near], distance[near], lamps[near, 3]
        slant = np.hypot(distance, mounting.height_cm)
        direction = towards / np.maximum(distance, 1e-9)[:, None]
        # A round glow in the image is longer on the floor, along the view, the flatter the view.
        along_cm = size_rad * slant**2 / mounting.height_cm
        level = np.full(len(distance), self.look.lamp_level)
        reach2 = 12.0 * along_cm**2
        return np.column_stack([eye + towards, direction, along_cm, size_rad * slant, level, reach2])


def _marking_tables(
    track: Track, brightness: float
) -> tuple[Float[np.ndarray, "m 7"], Float[np.ndarray, "k 2"]]:
    """Markings as numbers; on a loop each list of stretches goes on beyond both ends."""
    rows, stretches = [], [np.empty((0, 2))]
    count = 0
    for marking in track.markings:
        painted = marking.painted_cm
        if track.closed:
            painted = np.concatenate([painted - track.length_cm, painted, painted + track.length_cm])
        colour = np.minimum(np.asarray(marking.colour_bgr) * brightness, 255.0)
        rows.append([marking.offset_cm, marking.width_cm, *colour, count, count + len(painted)])
        stretches.append(painted)
        count += len(painted)
    return np.asarray(rows, dtype=np.float64).reshape(-1, 7), np.concatenate(stretches)


def _gains(camera: Camera, look: LookSettings) -> Float32[np.ndarray, "pixels 3"]:
    """Factor on each pixel and channel: exposure, white balance, darker corners."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    r2 = (u - 0.5 * (camera.width - 1)) ** 2 + (v - 0.5 * (camera.height - 1)) ** 2
    falloff = 1.0 - look.vignetting * r2 / r2.max()
    gains = falloff[..., None] * look.exposure * np.asarray(look.white_balance)
    return gains.reshape(-1, 3).astype(np.float32)
