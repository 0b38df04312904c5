"""The jobs that make label sets, one per drive: simulate or read it, map it, label it.

A job carries everything that it needs to another process. What it finished stays on disk and is not repeated,
see :mod:`datagen.made`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from datagen.datasets.settings import ROLES, DataSettings, RecordedSettings, Role
from datagen.datasets.splits import split_recording
from datagen.labels.truth import truth_labels
from datagen.made import Output, fingerprint, key_of
from datagen.pipeline import MapRequest, MapSettings, label_map, map_drive, map_key
from datagen.prepare import check_count
from datagen.slam.segment import StageProgress
from datagen.world.simulate import simulate_drive
from datagen.world.variety import first_world, vary_simulation
from datagen.world.world import SimulationSettings
from lanenet.data.camera_file import write_camera
from lanenet.data.files import write_text
from lanenet.data.label_set import read_label_index, read_labels, write_labels
from lanenet.data.maps.folder import read_map
from lanenet.data.maps.mapped_drive import open_mapped_drive
from lanenet.errors import CalibrationError, ConfigError, TrackingLostError
from lanenet.geometry.birdseye import BirdseyeWindow

#: Synthetic drives of each role whose map and labels get pictures. Chosen: nobody looks at those of hundreds.
_PICTURED = 2

#: The width of a map's lane is that of the settings within this share. Chosen: it is given, not measured.
_SAME_WIDTH = 0.01


@dataclass(frozen=True)
class Part:
    """A label set and its role.

    Attributes:
        role: What it is for.
        labels: Its file.
        frames: The simulated drive whose truth it holds, or the map that it was made from.
        counts_as: Number of training drives that this set counts as.
        weight: How often it is shown beside others.
    """

    role: Role
    labels: Path
    frames: Path
    counts_as: int = 1
    weight: float = 1.0


@dataclass(frozen=True)
class LeftOut:
    """Why a drive has no label set, for people."""

    reason: str


def finished_maps(runs: Path) -> list[Path]:
    """Return the maps that earlier commands and trainings finished in a folder of runs."""
    markers = sorted([*runs.glob("*/map.done.json"), *runs.glob("*/drives/maps/*/map.done.json")])
    return [marker.parent for marker in markers]


@dataclass(frozen=True)
class SyntheticJob:
    """Simulate a drive and label it: from a map, or for the test from the truth.

    Attributes:
        role: What its labels are for.
        number: Counted from 0, within the role.
        simulation: The drive.
        data: Settings of the run.
        folder: Folder of all synthetic drives, maps and labels.
    """

    role: Role
    number: int
    simulation: SimulationSettings
    data: DataSettings
    folder: Path

    @classmethod
    def draw(cls, data: DataSettings, role: Role, number: int, work_dir: Path) -> SyntheticJob:
        """Draw a drive; it follows from the seed, the role and the number alone."""
        # Each role has its own stream, so that more training drives leave the test drives as they are.
        synthetic, seed = data.synthetic, [data.synthetic.seed, ROLES.index(role), number]
        varied = synthetic.variety != "none"
        cameras = synthetic.cameras or (synthetic.simulation.camera,)
        simulation = vary_simulation(
            synthetic.simulation,
            np.random.SeedSequence(seed),
            number,
            cameras=cameras if synthetic.variety == "all" else (),
            road=varied,
            driver=varied,
        )
        return cls(role, number, simulation, data, work_dir / "synthetic")

    @property
    def name(self) -> str:
        """Name of its files."""
        return f"{self.role}_{self.number:02d}"

    @property
    def title(self) -> str:
        """Its name in messages."""
        return f"{self.name} (seed {self.simulation.seed})"

    @property
    def drive(self) -> Path:
        """The simulated drive."""
        return self.folder / "drives" / self.name

    @property
    def labels(self) -> Path:
        """The label set."""
        return self.folder / "labels" / f"{self.name}.parquet"

    @property
    def frames(self) -> Path:
        """The drive for the test, otherwise the map."""
        return self.drive if self.role == "test" else self.folder / "maps" / self.name

    @property
    def _map_settings(self) -> MapSettings:
        # The simulated camera does not see its car.
        return self.data.map.model_copy(update={"find_bumper": False})

    def run(self) -> tuple[Part, ...] | LeftOut:
        """Make the label set, or say why there is none.

        Raises:
            LanenetError: If it fails and no drive may.
        """
        # The truth needs no map, but its edges are found in the same way.
        mapped = self._map_settings.perception if self.role == "test" else self._map_settings
        key = key_of(self.simulation, self.role, self.data.window, self.data.colour_weight, mapped)
        labels, failure = Output(self.labels, key), Output(self.labels.with_suffix(".failed.txt"), key)
        if not labels.done and failure.done:
            return LeftOut(failure.path.read_text(encoding="utf-8"))
        try:
            labels.make_alone(self._make_labels)
        except (TrackingLostError, CalibrationError, ConfigError) as error:
            if self.role == "test" or not self.data.synthetic.may_fail:
                raise
            write_text(failure.path, str(error))
            failure.mark()
            return LeftOut(str(error))
        return (Part(self.role, self.labels, self.frames, weight=self.data.synthetic.weight),)

    def _make_labels(self) -> None:
        data, mapping, track = self.data, self._map_settings, self.simulation.track
        Output(self.drive / "drive.yaml", key_of(self.simulation)).make(self._simulate)
        if self.role == "test":
            perception = mapping.perception.with_colours(data.colour_weight)
            write_labels(self.labels, truth_labels(self.drive, perception, data.window, track.line_width_cm))
            return
        pictures, lane_cm = self.number < _PICTURED, track.lane_width_cm
        Output(self.frames / "map.yaml", key_of(self.simulation, mapping)).make(
            lambda: map_drive(MapRequest(self.drive, lane_cm), mapping, self.frames, pictures=pictures)
        )
        label_map(
            self.frames, self.labels, window=data.window, colour_weight=data.colour_weight, pictures=pictures
        )

    def _simulate(self) -> None:
        # A random road takes the first seed that leaves room for one.
        seed = first_world(self.simulation).settings.seed
        simulate_drive(self.simulation.model_copy(update={"seed": seed}), self.drive)


@dataclass(frozen=True)
class RecordedJob:
    """Map and label a recorded drive, and split it into the three roles if it is to be split.

    Attributes:
        recording: The drive.
        data: Settings of the run.
        folder: Folder of the maps and labels of all recorded drives.
        joined_in: Folder of joined maps, of which it is one that is listed by itself; else None.
    """

    recording: RecordedSettings
    data: DataSettings
    folder: Path
    joined_in: Path | None = None

    @property
    def title(self) -> str:
        """Its name in messages."""
        return self.recording.name or str(self.recording.path)

    @property
    def name(self) -> str:
        """Name of its files; two drives may have folders of the same name."""
        path = self.recording.path.resolve()
        return f"{path.name}-{key_of(str(path))[:6]}"

    @property
    def is_map(self) -> bool:
        """Whether the drive has been mapped before."""
        return (self.recording.path / "map.yaml").is_file()

    @property
    def is_labels(self) -> bool:
        """Whether it has been labelled before."""
        return self.recording.path.suffix == ".parquet"

    @property
    def frames(self) -> Path:
        """The map, or the label set of a drive that has been labelled before."""
        given = self.is_map or self.is_labels
        return self.recording.path if given else self.folder / "maps" / self.name

    @property
    def whole(self) -> Path:
        """The labels of the whole drive."""
        given = self.is_labels and self._given_window == self.data.window
        return self.recording.path if given else self.folder / "labels" / f"{self.name}.parquet"

    @property
    def _given_window(self) -> BirdseyeWindow:
        return read_label_index(self.recording.path).meta.window

    def camera_file(self) -> Path | None:
        """Return the file of the drive's camera; None for a label set that does not hold it.

        Raises:
            LabelFormatError: If the label set cannot be read.
        """
        if not self.is_labels:
            return self.frames / "camera.yaml"
        camera = read_label_index(self.recording.path).meta.camera
        if camera is None:
            return None
        path = self.folder / "labels" / f"{self.name}.camera.yaml"
        write_camera(path, camera, f"that of the label set {self.recording.path}")
        return path

    @property
    def map_output(self) -> Output:
        """The map that is made of a drive that has not been mapped before.

        Raises:
            DriveFormatError: If there is no such drive.
        """
        return Output(self.frames / "map.yaml", map_key(self._request, self.recording.map), moves=True)

    @property
    def _request(self) -> MapRequest:
        known = self.recording
        return MapRequest(
            known.path,
            known.lane_width_cm,
            known.camera,
            wheelbase_cm=known.wheelbase_cm,
            camera_height_cm=known.camera_height_cm,
            tape_width_cm=known.tape_width_cm,
            frames=known.frames,
        )

    @property
    def is_mapped(self) -> bool:
        """Whether nothing is left to be mapped.

        Raises:
            DriveFormatError: If there is no such drive.
        """
        return self.is_map or self.is_labels or self.map_output.done

    def count_frames(self) -> int:
        """Return the number of frames, in a map or a label set only those with poses or labels.

        Raises:
            LanenetError: If the drive, the map or the label set cannot be read.
        """
        if self.is_labels:
            return len(read_labels(self.recording.path))
        return len(read_map(self.frames).frames) if self.is_map else len(self._request.open_drive())

    def check_long_enough(self) -> None:
        """Refuse a recording that is too short to be mapped, before others are mapped for minutes.

        Frames in which the car stands are left out later.

        Raises:
            TrackingLostError: Names the number of frames.
            LanenetError: If the drive cannot be read.
        """
        if not self.is_mapped:
            check_count(self._request.open_drive())

    def make_map(self, progress: StageProgress | None = None) -> None:
        """Map the drive, unless it has been mapped before.

        Args:
            progress: Called with (stage, done, total).

        Raises:
            LanenetError: If the drive cannot be read or mapped, or was recorded anew since it was mapped.
            ConfigError: If it is a map of a lane of another width, or frames are to be chosen from a map.
        """
        settings = self.recording
        if not (self.is_map or self.is_labels):
            # One of another lane width is only rescaled.
            earlier = finished_maps(self.folder.parent.parent)
            self.map_output.make(
                lambda: map_drive(self._request, settings.map, self.frames, progress, earlier=earlier)
            )
            return
        if settings.frames is not None:
            raise ConfigError(f"data.drives: {self.frames} is finished: frames are chosen before mapping")
        if self.is_map:
            self._check_width()
            # Labels that are there already may need no drive; but not another one.
            if Path(read_map(self.frames).meta.drive).exists():
                open_mapped_drive(self.frames)

    def run(self) -> tuple[Part, ...]:
        """Make the three label sets, or the one that holds all of the drive.

        Raises:
            LanenetError: If the drive cannot be read, mapped or split.
            ConfigError: As :meth:`make_map`.
        """
        settings, data = self.recording, self.data
        files = [settings.path]
        if settings.camera is not None and settings.camera.is_file():
            files.append(settings.camera)
        # What people say for others changes no label, nor does how often it is shown.
        known = settings.model_dump(mode="json", exclude={"name", "track", "licence", "car", "weight"})
        key = key_of(known, data.window, data.colour_weight, *map(fingerprint, files))
        folder = self.folder / "labels"
        is_whole = len(settings.parts) == 1
        parts = tuple(
            Part(
                role,
                self.whole if is_whole else folder / f"{self.name}.{role}.parquet",
                self.frames,
                settings.counts_as if role == "train" else 1,
                settings.weight,
            )
            for role in settings.parts
        )
        # The last file that is written stands for all.
        done = Output(parts[-1].labels, key)

        def make() -> None:
            self.make_map()
            if not self.is_labels:
                window, weight = data.window, data.colour_weight
                label_map(self.frames, self.whole, window=window, colour_weight=weight)
            elif self.whole != settings.path:
                write_labels(self.whole, read_labels(settings.path).in_window(data.window))
            if is_whole:
                return
            labels = read_labels(self.whole)
            for part, split in zip(parts, split_recording(labels, settings), strict=True):
                write_labels(part.labels, split)

        if not all(path.is_file() for path in (self.whole, *(part.labels for part in parts))):
            done.forget()
        done.make_alone(make)
        return parts

    def _check_width(self) -> None:
        meta, given_cm = read_map(self.frames).meta, self.recording.lane_width_cm
        mapped_cm = meta.lane_width_cm
        if abs(mapped_cm - given_cm) > _SAME_WIDTH * given_cm:
            raise ConfigError(
                f"data.drives: {self.frames} is a map of a lane of {mapped_cm:g} cm, but lane_width_cm is "
                f"{given_cm:g}; give the map's, or {meta.width_command(self.frames, given_cm)}"
            )


@dataclass(frozen=True)
class CompileJob:
    """Call a function with the first label set that exists, to compile what the training needs.

    Attributes:
        call: A function of a module.
        label_sets: Label sets that may exist by then.
    """

    call: Callable[[Path], object]
    label_sets: tuple[Path, ...]
    title: str = "compiling"

    def run(self) -> tuple[Part, ...]:
        """Do it; makes no label set."""
        path = next((path for path in self.label_sets if path.is_file()), None)
        if path is not None:
            self.call(path)
        return ()


Job = SyntheticJob | RecordedJob | CompileJob


def run_job(job: Job) -> tuple[Part, ...] | LeftOut:
    """Run a job; a function of a module, since it is called in other processes."""
    return job.run()
