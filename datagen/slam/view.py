"""What the images of a segment show before its motion is known: edges of the road, and the typical step."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from datagen.slam.adjustment.adjust import Observations
from datagen.slam.commands import CommandedMotion
from datagen.slam.keyframes import interleaved_rows
from datagen.slam.odometry.image_pairs import ImagePairs
from datagen.slam.odometry.odometry import TypicalStep, typical_step
from datagen.slam.odometry.scans import Scans, edges_of_drive, scans_of
from datagen.slam.odometry.stillness import without_reflections
from datagen.slam.odometry.uneven import early_frames, measured_periods
from datagen.slam.settings import SlamSettings
from datagen.slam.stripes import true_borders
from lanenet.data.drives import Drive
from lanenet.errors import TrackingLostError
from lanenet.geometry.camera import Camera, Mounting
from lanenet.perception.edges.pixels import EdgePixels
from lanenet.perception.edges.road import RangeSettings, RoadTable

#: Road that one pixel may span, in camera heights: about the width of a tape, 5 cm for a camera 17 cm high.
_COARSEST_HEIGHTS = 0.3
#: Range of the mapping, in camera heights. Far edges place a line badly, but hold the heading. With a focal
#: length of 120 px a pixel spans as much as the limit above there; with 80 px it does at 4.9 heights.
_REACH_HEIGHTS = 6.0
#: Edge points below which a frame shows no road, and below which, on average, a segment cannot be tracked.
#: Chosen: road without lines, but with seams and stains, has more; a blank floor has hardly any.
LEAST_POINTS = 20


def mapping_range(mounting: Mounting, base: RangeSettings) -> RangeSettings:
    """Range of the road for mapping, in proportion to the camera's height; rows stay as configured."""
    reach = _REACH_HEIGHTS * mounting.height_cm
    coarsest = _COARSEST_HEIGHTS * mounting.height_cm
    far = reach + mounting.lead_cm
    return base.model_copy(update={"far_cm": far, "side_cm": reach, "max_cm_per_px": coarsest})


@dataclass(frozen=True)
class RoadView:
    """Edges of the road in every frame.

    Attributes:
        edges: Edge pixels per frame.
        keep: Pixels in which they were looked for, 0 elsewhere.
        limits: Range of the road that counts.
    """

    edges: list[EdgePixels]
    keep: UInt8[np.ndarray, "h w"]
    limits: RangeSettings

    @property
    def shows_road(self) -> Bool[np.ndarray, "n"]:
        """Frames with enough edges on the road to be tracked by."""
        return np.array([len(pixels.uv_px) >= LEAST_POINTS for pixels in self.edges])

    def scans(self, camera: Camera, tilt_rad: Float[np.ndarray, "n 2"] | None = None) -> Scans:
        """Move the edges to the road, with the camera tilted in each frame beyond its mounting."""
        return scans_of(self.edges, camera, self.limits, tilt_rad)

    def observed(self, commands: CommandedMotion) -> Observations:
        """For the bundle adjustment: the edges, with what was commanded and how long each step took."""
        return Observations(
            self.edges,
            self.keep,
            commands.relative_steps,
            commands.speed_known,
            commands.periods,
            commands.uneven,
        )


def view_road(
    drive: Drive, camera: Camera, settings: SlamSettings, keys: Int[np.ndarray, "k"] | None = None
) -> RoadView:
    """Find the edges of the road in every frame, without those of lamps that are mirrored in it.

    Borders of narrow lines are put where they are, see :mod:`datagen.slam.stripes`.

    Args:
        drive: The drive.
        camera: Its camera.
        settings: How edges are found.
        keys: Keyframes of a slow car: what stands still is recognised over as much road as between them.
    """
    limits = mapping_range(camera.mounting, settings.perception.range)
    table = RoadTable(camera, limits)
    found = [on_road(pixels, table) for pixels in edges_of_drive(drive, settings.perception.edges, table)]
    kept = list(found)
    for rows in [np.arange(len(found))] if keys is None else interleaved_rows(keys, len(found)):
        for k, pixels in zip(rows, without_reflections([found[k] for k in rows], camera, table), strict=True):
            kept[k] = pixels
    return RoadView([on_road(p, table) for p in true_borders(kept, table)], table.keep, limits)


def on_road(pixels: EdgePixels, table: RoadTable) -> EdgePixels:
    """Drop edges without a place on the road: at the rim of a lens, half a pixel further there is none."""
    good = np.isfinite(table.lift_points(pixels)).all(axis=1)
    return pixels if good.all() else EdgePixels(pixels.uv_px[good], pixels.normals[good])


@dataclass(frozen=True)
class SegmentView:
    """What the images of a segment show, before its motion is known.

    Attributes:
        drive: The segment.
        camera: Its camera, or a coarse guess of it.
        commands: What was commanded.
        road: Edges of the road.
        scans: The same on the road.
        images: The same, ready to be compared from image to image.
        typical: The typical step length, and what the commands mean in centimetres.
    """

    drive: Drive
    camera: Camera
    commands: CommandedMotion
    road: RoadView
    scans: Scans
    images: ImagePairs
    typical: TypicalStep

    @property
    def steps_heights(self) -> Float[np.ndarray, "n"]:
        """Rough step length of each frame, in camera heights."""
        return self.typical.step_heights * self.typical.relative


def with_measured_periods(view: SegmentView) -> SegmentView:
    """Measure the times of frames that came unevenly, see :mod:`datagen.slam.odometry.uneven`.

    A recorded speed knows the steps better.
    """
    if view.commands.speed_known:
        return view
    early = early_frames(view.drive)
    if not early.any():
        return view
    periods, uneven = measured_periods(view.images, view.typical.step_heights, early)
    images = view.images.with_periods(np.where(uneven, periods, view.images.periods))
    typical = replace(view.typical, relative=view.typical.relative * periods)
    # Later stages start from the odometry; these times are too rough to be held against them.
    return replace(view, commands=replace(view.commands, uneven=uneven), images=images, typical=typical)


def view_segment(
    drive: Drive,
    camera: Camera,
    commands: CommandedMotion,
    settings: SlamSettings,
    rng: np.random.Generator,
) -> SegmentView:
    """Find the edges of the road in a segment, and the typical step length.

    Raises:
        TrackingLostError: If there are too few edges.
    """
    road = view_road(drive, camera, settings)
    scans = road.scans(camera)
    if len(scans.points_cm) < LEAST_POINTS * len(scans):
        raise TrackingLostError(
            f"{drive.path}: {len(scans.points_cm) / max(len(scans), 1):.0f} edge points per frame on the "
            f"road; mapping needs {LEAST_POINTS}"
        )
    images = ImagePairs(road.edges, camera, settings.odometry, rng, commands.periods)
    typical = typical_step(images, commands.distance_cm, commands.speed_known)
    return SegmentView(drive, camera, commands, road, scans, images, typical)
