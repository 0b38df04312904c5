"""What a map knows, as a recording is told it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float

from lanenet.data.drives import Drive
from lanenet.data.maps.folder import DriveMap, read_edges
from lanenet.data.maps.mapped_drive import lines_at, open_mapped_drive
from lanenet.errors import DriveFormatError
from lanenet.viewers.seen import Lane, Scene, Seen

#: Distance between the points of a drawn line, [cm]. Chosen: bends of 50 cm look smooth.
_DRAWN_CM = 2.0
#: Most edge points of a map that are drawn. Chosen: the lines of a room can be seen, and 0.4 MB.
_EDGES = 30_000


class MapToSee:
    """A map, and what it says about each of its frames.

    Attributes:
        mapped: The map and its drive.
    """

    def __init__(self, folder: Path) -> None:
        """Open a map folder.

        Raises:
            LanenetError: If the map or its drive cannot be read.
        """
        self.mapped = open_mapped_drive(folder)
        self._folder = folder
        self._row = {int(frame): k for k, frame in enumerate(self.drive_map.frames)}

    @property
    def drive_map(self) -> DriveMap:
        """The map."""
        return self.mapped.drive_map

    @cached_property
    def scene(self) -> Scene:
        """What stays the same."""
        edges = read_edges(self._folder)
        every = max(1, -(-len(edges) // _EDGES))
        return Scene(
            self._folder.resolve().name,
            self.drive_map.camera,
            self.mapped.perception,
            map_lines(self.drive_map),
            edges[::every],
            self.drive_map.poses,
        )

    def add_to(self, seen: Seen) -> Seen:
        """Add to a frame of the map's drive its pose, the camera's tilt and the lines of the map."""
        k = self._row.get(seen.frame)
        if k is None:
            return seen
        found = lines_at(self.drive_map, k)
        reference = Lane(found.points_cm, (found.left_cm, found.right_cm))
        return replace(
            seen,
            lanes={"reference": reference, **seen.lanes},
            values={"map_match": float(self.drive_map.match[k]), **seen.values},
            pose=self.drive_map.poses[k],
            camera=self.drive_map.camera_at(k),
        )

    def frames(self) -> Iterator[Seen]:
        """Yield every frame of the map, with the steering that the car got.

        That is ``steering_rad``, or where the largest angle is unknown ``steering_share`` of it, -1 to 1;
        both are positive to the left.
        """
        drive = self.mapped.drive
        name, steering = _steering(drive)
        for k, row in enumerate(self.mapped.rows.tolist()):
            try:
                image = drive.image(row)
            except DriveFormatError:
                image = None
            values = {} if steering is None else {name: float(steering[row])}
            yield self.add_to(
                Seen(int(drive.frames[row]), float(self.drive_map.t_s[k]), image, values=values)
            )


def _steering(drive: Drive) -> tuple[str, Float[np.ndarray, "n"] | None]:
    """The steering of a recording, positive to the left, and its name."""
    commands = drive.commands
    if commands.steering_rad is not None or commands.angle is None:
        return "steering_rad", commands.steering_rad
    # Donkeycar's sign is the other way round.
    if drive.max_steering_rad is not None:
        return "steering_rad", -commands.angle * drive.max_steering_rad
    return "steering_share", -commands.angle


def map_lines(drive_map: DriveMap) -> dict[str, Float[np.ndarray, "_ 2"]]:
    """Return the lines of a map by segment, side and rank, frame map; NaN where a line is not supported."""
    lines = {}
    for segment, found in drive_map.lines.items():
        for line in found:
            start, end = line.span_cm
            s_cm = line.with_corners(np.linspace(start, end, max(2, int((end - start) / _DRAWN_CM) + 1)))
            lines[f"{segment}/{line.side}_{line.rank}"] = line.points(s_cm)
    return lines
