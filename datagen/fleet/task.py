"""A drive to be labelled: what is known of it, and the keys that its map and its labels are kept under."""

from __future__ import annotations

from dataclasses import dataclass

from pydantic import Field

from datagen.fleet.source import on_this_machine
from datagen.made import key_of
from datagen.settings import MapSettings
from lanenet.config import Settings
from lanenet.data import label_set
from lanenet.data.camera_file import read_camera
from lanenet.perception.edges.road import COLOUR_WEIGHT

#: Kinds of result.
MAPS, LABELS, CAMERAS, TRACKS = "maps", "labels", "cameras", "tracks"


class FleetSettings(Settings):
    """What all drives of a run are made with.

    Attributes:
        map: Settings of the mapping.
        colour_weight: Weight of colour beside brightness in the edges that the network sees.
        pictures: Draw the report page of each map and the frames of each label set.
    """

    map: MapSettings = MapSettings()
    colour_weight: float = Field(default=COLOUR_WEIGHT, ge=0.0, le=1.0)
    pictures: bool = False


@dataclass(frozen=True)
class FleetDrive:
    """A drive, and what people know about it; see :class:`datagen.pipeline.MapRequest`.

    Attributes:
        name: Unique in a run; the drive's name in its label set.
        source: Path or URL, the same on every machine.
        checksum: Of its files, see :func:`datagen.fleet.source.checksum`.
        lane_width_cm: Distance between the middles of the two lines of the driven lane; None if only the
            drive could say it, and cannot be read.
        camera: Camera file or an earlier map, the same path on every machine; None for the drive's own.
        wheelbase_cm: Distance between the axles; None if unknown.
        camera_height_cm: Height of the lens above the road; None if unknown.
        tape_width_cm: Width of the tape; None if unknown.
        car: Name of the car, or of one of its cameras: drives of one name are taken for drives with one
            camera; empty if unknown.
        track: Name of the track; empty if unknown.
    """

    name: str
    source: str
    checksum: str
    lane_width_cm: float | None
    camera: str | None = None
    wheelbase_cm: float | None = None
    camera_height_cm: float | None = None
    tape_width_cm: float | None = None
    car: str = ""
    track: str = ""

    def map_key(self, settings: FleetSettings) -> str:
        """Return the key of its map: of the recording, what is known of it, and all settings of the mapping.

        Raises:
            CalibrationError: If the camera cannot be read.
        """
        # Its car and track change what becomes of the map, not the map.
        known = {key: value for key, value in vars(self).items() if key not in ("car", "track")}
        known |= {"name": None, "source": None}
        if self.camera is not None:
            with on_this_machine(self.camera) as path:
                camera = read_camera(path)
            known["camera"] = [camera.hash, camera.wheelbase_cm]
        return key_of(MAPS, known, settings.map, settings.pictures)

    def labels_key(self, settings: FleetSettings) -> str:
        """Return the key of its labels: of its map, its name and all settings of the labels.

        Raises:
            CalibrationError: As :meth:`map_key`.
        """
        made = (settings.colour_weight, settings.pictures)
        return key_of(LABELS, label_set.FORMAT, self.map_key(settings), self.name, *made)
