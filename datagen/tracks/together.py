"""Drives adjusted together: those of one track, every place of which is held by all drives that saw it.

Where cars shared one camera, its numbers are adjusted, too. Other drives keep theirs: their edges are drawn
as the camera of the first drive would have seen them, so that all of them can be compared in pixels. Drives
of several tracks can share a camera as well; then each is held by its own laps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int, UInt8

from datagen.slam.adjustment.adjust import BundleEstimate, BundleResult, Observations, adjust
from datagen.slam.filter.dp_slam import Trajectory
from datagen.slam.keyframes import keyframe_pairs
from datagen.slam.loops.parts import whole_turns
from datagen.slam.loops.pose_graph import neighbouring_laps
from datagen.slam.loops.revisits import Revisit
from datagen.slam.odometry.scans import Scans, lift_tilted, scans_of
from datagen.slam.segment import SolvedSegment
from datagen.slam.view import mapping_range
from datagen.tracks.visit import Visit
from lanenet.geometry.camera import Camera
from lanenet.geometry.frames import wrap_angle
from lanenet.geometry.poses import relative_pose
from lanenet.perception.edges.pixels import EdgePixels
from lanenet.perception.edges.road import RoadEdges

#: Every so many frames one is paired with the nearest frame of each other drive. Chosen: as between laps.
_EVERY = 3
#: Frames of two drives see the same road if the places so far ahead of their rear axles, in camera heights,
#: are this close, and their headings alike or opposite to this, [rad]. Chosen: where edges are dense, and
#: less than the width of a lane beyond it.
_AHEAD_HEIGHTS, _NEAR_HEIGHTS, _NEAR_RAD = 3.0, 2.5, 0.5
#: Rounds in which a shared camera and the poses are adjusted: another camera sees other edges on the road,
#: and a drive that was mapped with another one has to shrink or grow. Two halves of ``garage_tape``, whose
#: scales differed by 2.3 %, lay 0.65 cm from the map of the whole drive after one round (p95 of the lines)
#: and 0.33 cm after four.
_ROUNDS = 4
#: A gap of so many periods lies before each drive: nothing is known of the motion from one to the next.
_APART_PERIODS = 1e3


@dataclass(frozen=True, eq=False)
class Together:
    """Drives in the scale of the first one, and of one track also in its map frame.

    Attributes:
        visits: The drives, adjusted.
        solved: All of their frames, one drive after the other.
        of: Drive of each of these frames.
    """

    visits: tuple[Visit, ...]
    solved: SolvedSegment
    of: Int[np.ndarray, "n"]

    def solved_of(self, number: int) -> SolvedSegment:
        """Return the frames of one drive, as a segment of its own."""
        rows = np.flatnonzero(self.of == number)
        own = self.solved.only(rows)
        return replace(own, rows=np.arange(len(rows)), part=own.part - own.part[0])


def solve_together(
    visits: Sequence[Visit], shared: bool, rng: np.random.Generator, one_track: bool = True
) -> Together:
    """Adjust drives together.

    Args:
        visits: The drives; those of one track moved onto the first one's map, others in its scale.
        shared: Whether they shared one camera, which is then adjusted.
        rng: Draws the edges that are compared.
        one_track: Whether their maps lie on each other; else no drive is compared with another.
    """
    settings, first = visits[0].prepared.settings, visits[0]
    of = np.repeat(np.arange(len(visits)), [len(one.poses) for one in visits])
    camera = mean_camera(visits) if shared else first.camera
    tilt = np.concatenate([one.tilt_rad if shared else np.zeros((len(one.poses), 2)) for one in visits])
    estimate = BundleEstimate(np.concatenate([one.poses for one in visits]), tilt, camera)
    loops = _loops(visits, estimate.poses, of, camera, one_track)
    if shared:
        found, observed = _with_camera(visits, estimate, loops, rng)
        edges: list[EdgePixels] = list(observed.edges)
    else:
        observed = _as_seen_by(visits, camera)
        found = adjust(observed, estimate, settings.bundle, rng, (), loops)
        edges = list(observed.edges)
    limits = mapping_range(camera.mounting, settings.perception.range)
    scans = scans_of(edges, found.camera, limits, found.tilt)
    ends = np.cumsum([0, *np.bincount(of)])
    adjusted = []
    for one, start, stop in zip(visits, ends[:-1], ends[1:], strict=True):
        own = found.tilt[start:stop]
        adjusted.append(
            replace(
                one,
                poses=found.poses[start:stop],
                tilt_rad=own if shared else one.tilt_rad + own,
                camera=found.camera if shared else one.camera,
                sigma=found.sigma if shared else one.sigma,
            )
        )
    return Together(tuple(adjusted), _segment(visits, found, scans, of), of)


def mean_camera(visits: Sequence[Visit]) -> Camera:
    """Return the mean of the drives' cameras, each number weighted by how well it is known."""
    cameras = [one.camera for one in visits]
    lens = [_weights(visits, name) for name in ("focal", "cx", "cy", "k1")]
    K = np.array(cameras[0].K)
    for (row, column), weight in zip(((0, 0), (0, 2), (1, 2)), lens[:3], strict=True):
        K[row, column] = sum(w * one.K[row, column] for w, one in zip(weight, cameras, strict=True))
    K[1, 1] = sum(w * one.K[1, 1] for w, one in zip(lens[0], cameras, strict=True))
    D = sum(w * one.D for w, one in zip(lens[3], cameras, strict=True))
    names = {
        "pitch_down_rad": "pitch",
        "roll_rad": "roll",
        "yaw_rad": "yaw",
        "ahead_of_front_axle_cm": "lever",
        "height_cm": "focal",
    }
    mounting = {
        name: float(
            sum(
                w * getattr(one.mounting, name)
                for w, one in zip(_weights(visits, known), cameras, strict=True)
            )
        )
        for name, known in names.items()
    }
    return replace(cameras[0], K=K, D=np.asarray(D)).with_mounting(**mounting)


def _weights(visits: Sequence[Visit], name: str) -> Float[np.ndarray, "v"]:
    sigma = np.array([one.sigma.get(name, 0.0) for one in visits])
    # A given camera has no sigmas, and outweighs all that were found.
    inverse = 1.0 / np.maximum(sigma, 1e-3 * max(float(sigma.max()), 1e-9)) ** 2
    return np.asarray(inverse / inverse.sum())


def _with_camera(
    visits: Sequence[Visit],
    estimate: BundleEstimate,
    loops: list[tuple[int, int]],
    rng: np.random.Generator,
) -> tuple[BundleResult, Observations]:
    """Adjust poses and the shared camera, then the poses once more with the camera held."""
    settings = visits[0].prepared.settings
    camera = estimate.camera
    K = np.array(camera.K)
    K[:2, 2] = 0.5 * (camera.width - 1), 0.5 * (camera.height - 1)
    D = np.array(camera.D)
    D[0] = settings.guess.k1
    # Principal point, roll and distortion have the priors of any camera, not what single drives found.
    prior = replace(camera, K=K, D=D).with_mounting(roll_rad=0.0)
    found: BundleEstimate = estimate
    sigma: dict[str, float] = {}
    for _ in range(_ROUNDS):
        observed = _observed(visits, found.camera)
        result = adjust(
            observed, found, settings.bundle.with_free_tilt(), rng, loops=loops, prior_camera=prior
        )
        found, sigma = result, result.sigma
    settled = adjust(observed, found, settings.bundle, rng, (), loops)
    return replace(settled, sigma=sigma), observed


def _observed(visits: Sequence[Visit], camera: Camera) -> Observations:
    """What all frames show with one camera."""
    roads = [one.road(camera) for one in visits]
    keep: UInt8[np.ndarray, "h w"] = roads[0].keep
    for road in roads[1:]:
        keep = np.minimum(keep, road.keep)
    edges = [pixels for road in roads for pixels in road.edges]
    return _with_commands(visits, edges, keep)


def _with_commands(
    visits: Sequence[Visit], edges: list[EdgePixels], keep: UInt8[np.ndarray, "h w"] | None
) -> Observations:
    periods = []
    for one in visits:
        own = one.commands.periods.copy()
        own[0] = _APART_PERIODS
        periods.append(own)
    steps = [one.commands.relative_steps for one in visits]
    recorded = all(one.commands.speed_known for one in visits)
    return Observations(edges, keep, np.concatenate(steps), recorded, np.concatenate(periods))


def _as_seen_by(visits: Sequence[Visit], camera: Camera) -> Observations:
    """Draw what all drives saw, with the tilts of their frames, as one level camera would have seen it."""
    edges = []
    for one in visits:
        behind_cm = one.camera.wheelbase_cm - camera.wheelbase_cm
        for road in lift_tilted(one.road(one.camera).edges, one.camera, one.tilt_rad):
            edges.append(_projected(road, behind_cm, camera))
    keep = np.full((camera.height, camera.width), 255, np.uint8)
    return _with_commands(visits, edges, keep)


def _projected(road: RoadEdges, behind_cm: float, camera: Camera) -> EdgePixels:
    """Project edges on the road into a camera whose front axle lies so far before that of their own car."""
    points = road.points_cm + [0.0, behind_cm]
    along = np.column_stack([-road.normals[:, 1], road.normals[:, 0]])
    step_cm = 0.01 * camera.mounting.height_cm
    at, beside, towards = (
        camera.project_ground(points + step_cm * way) for way in (0.0 * along, along, road.normals)
    )
    tangent = beside - at
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
    normal *= np.where(np.sum(normal * (towards - at), axis=1) < 0.0, -1.0, 1.0)[:, None]
    normal /= np.maximum(np.hypot(*normal.T), 1e-12)[:, None]
    inside = np.isfinite(at).all(axis=1) & np.isfinite(normal).all(axis=1)
    inside &= ((at >= 0.0) & (at <= [camera.width - 1, camera.height - 1])).all(axis=1)
    return EdgePixels(at[inside], normal[inside])


def _loops(
    visits: Sequence[Visit],
    poses: Float[np.ndarray, "n 3"],
    of: Int[np.ndarray, "n"],
    camera: Camera,
    one_track: bool,
) -> list[tuple[int, int]]:
    """Pairs of frames that show the same road: of laps of one drive, and of different drives of a track."""
    height_cm = camera.mounting.height_cm
    pairs: list[tuple[int, int]] = []
    for number, one in enumerate(visits):
        rows = np.flatnonzero(of == number)
        settings, keys = one.prepared.settings, one.keys
        own = neighbouring_laps(poses[rows], height_cm, settings.revisits)
        if keys is not None:
            own += keyframe_pairs(keys, settings.bundle.lags, one.commands.part)
        pairs += [(int(rows[a]), int(rows[b])) for a, b in own]
        for other in range(number if one_track else 0):
            pairs += views_shared(poses, np.flatnonzero(of == other), rows, height_cm)
    return pairs


def views_shared(
    poses: Float[np.ndarray, "n 3"],
    earlier: Int[np.ndarray, "a"],
    later: Int[np.ndarray, "b"],
    height_cm: float,
) -> list[tuple[int, int]]:
    """Pairs of frames of two drives that see the same road, from the same side or from opposite ones.

    Args:
        poses: Poses of all frames.
        earlier: Frames of one drive.
        later: Frames of the other one.
        height_cm: Height of the camera, which sets the scale.
    """
    ahead = np.column_stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])])
    seen = poses[:, :2] + _AHEAD_HEIGHTS * height_cm * ahead
    pairs = []
    for frame in later[::_EVERY]:
        apart = np.hypot(*(seen[earlier] - seen[frame]).T)
        turned = np.abs(wrap_angle(poses[earlier, 2] - poses[frame, 2]))
        for alike in (turned < _NEAR_RAD, turned > np.pi - _NEAR_RAD):
            near = np.where(alike, apart, np.inf)
            best = int(np.argmin(near))
            if near[best] < _NEAR_HEIGHTS * height_cm:
                pairs.append((int(earlier[best]), int(frame)))
    return pairs


def _segment(
    visits: Sequence[Visit], found: BundleResult, scans: Scans, of: Int[np.ndarray, "n"]
) -> SolvedSegment:
    """Put the frames of all drives together as one segment in parts."""
    parts, revisits, before = [], [], 0
    height_cm = found.camera.mounting.height_cm
    for number, one in enumerate(visits):
        rows = np.flatnonzero(of == number)
        own = one.commands.part
        parts.append(before + own)
        before += int(own[-1]) + 1
        poses = found.poses[rows]
        for a, b in neighbouring_laps(poses, height_cm, one.prepared.settings.revisits):
            between = relative_pose(poses[a], poses[b])
            seen = Revisit(a, b, between, 1.0)
            revisits.append(
                replace(seen, earlier=int(rows[a]), later=int(rows[b]), turns=whole_turns(poses, seen))
            )
    n = len(found.poses)
    match = np.concatenate([one.match for one in visits])
    return SolvedSegment(
        rows=np.arange(n),
        camera=found.camera,
        scans=scans,
        trajectory=Trajectory(found.poses, np.ones(n), match, np.zeros(n)),
        open_poses=np.concatenate([one.poses for one in visits]),
        poses=found.poses,
        steering=None,
        revisits=revisits,
        bundle=found,
        part=np.concatenate(parts),
    )
