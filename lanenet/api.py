"""The package in Python: a network as a function of an image, and four commands as functions.

Each calls what its command calls. Imports stand in the functions, so that ``import lanenet`` costs nothing:
the car has neither torch nor numba.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from datagen.pipeline import MapSettings, Report
    from lanenet.config import Settings, SettingsT
    from lanenet.evaluation.detect import DetectReport
    from lanenet.geometry.camera import Camera
    from lanenet.perception.network.detector import NetworkDetector


def load(
    model: str | Path,
    *,
    camera: Camera | str | Path | None = None,
    lane_width_cm: int | float | None = None,
    any_camera: bool = False,
) -> NetworkDetector:
    """Open a network for a camera: the detector that ``lanenet detect`` and ``lanenet drive`` use.

    It keeps the lane from frame to frame, so give it the frames of one drive in their order, and call its
    ``reset()`` before those of another.

    Args:
        model: Checkpoint folder or ONNX file, or ``hf:owner/name`` on the Hugging Face Hub.
        camera: The camera of the images: a camera file, the folder of a map, or a camera. None takes the
            ``camera.yaml`` beside a model that was trained with that camera alone.
        lane_width_cm: Between the middles of the lane's two lines. None takes it from the frames that show
            both.
        any_camera: Accept a camera that the model was not trained with, if both are calibrated.

    Returns:
        A function of an image, BGR as OpenCV reads it, of the camera's size, that returns a
        :class:`lanenet.perception.estimate.LaneEstimate`.

    Raises:
        CalibrationError: If the camera cannot be read, or none is given and the model is for several cameras
            or has none beside it.
        ConfigError: If the lane width is no centimetres.
        ModelMismatchError: If there is no model, or it was made for another camera.
    """
    import logging

    from lanenet.data.camera_file import read_camera
    from lanenet.data.hub import pulled
    from lanenet.errors import CalibrationError
    from lanenet.geometry.camera import Camera
    from lanenet.geometry.lane import check_lane_width
    from lanenet.perception.estimate import DetectorInputs
    from lanenet.perception.network.detector import KIND, NetworkDetector
    from lanenet.perception.network.model_file import find_model
    from lanenet.perception.registry import build_detector

    width_cm = _float(lane_width_cm)
    if width_cm is not None:
        check_lane_width(width_cm)
    file = find_model(pulled(model))
    own = file.parent / "camera.yaml"
    if camera is None and not own.is_file():
        raise CalibrationError(f"{model}: expected a camera (camera=...), since none lies beside the model")
    used = camera if isinstance(camera, Camera) else read_camera(own if camera is None else Path(camera))
    inputs = DetectorInputs(camera=used, model=file, any_camera=any_camera, lane_width_cm=width_cm)
    detector = build_detector(KIND.name, inputs)
    assert isinstance(detector, NetworkDetector)
    if camera is None and detector.meta.camera_hashes != (used.hash,):
        raise CalibrationError(
            f"{model}: is a network for several cameras, so it has to be told which one took the images: "
            "expected camera=... with a camera file or a map; lanenet map finds the camera of a drive"
        )
    for problem in detector.problems:
        logging.getLogger(__name__).warning(problem)
    return detector


def map(
    drive: str | Path,
    out: str | Path,
    *,
    lane_width_cm: int | float,
    camera: str | Path | None = None,
    config: MapSettings | Mapping[str, Any] | str | Path | None = None,
    refine_camera: bool = False,
    wheelbase_cm: int | float | None = None,
    camera_height_cm: int | float | None = None,
    tape_width_cm: int | float | None = None,
    frames: tuple[int, int] | None = None,
    force: bool = False,
) -> Report:
    """Find the poses of a drive and a map of its lane lines, as ``lanenet map``; without a camera, that too.

    Shows its progress on stderr. Needs ``lanenet[data]``.

    Args:
        drive: Drive, tub or video.
        out: Folder for the map, with ``report.html`` and ``camera.yaml`` in it.
        lane_width_cm: Between the middles of the lane's two lines.
        camera: Camera file, or an earlier map of the same car.
        config: Settings of the mapping, or their file.
        refine_camera: Adjust a known camera to this drive.
        wheelbase_cm: Distance between the car's axles.
        camera_height_cm: Height of the lens above the road: helps to find a camera that is not known.
        tape_width_cm: Width of the tape: checks the lane width.
        frames: First and last number of the frames to map; None for all of them.
        force: Replace the map of another drive in ``out``, too.

    Returns:
        ``lines`` for people, of which the first is the verdict, and ``figures`` for programs. The
        grade, ``figures["verdict"]["grade"]``, is ``good``, ``usable`` or ``reject``; :func:`label` refuses
        the last.

    Raises:
        CalibrationError: If the camera does not fit the images or the lane width.
        ConfigError: If the lane width is no centimetres, or a setting is wrong.
        LanenetError: If the drive cannot be read or mapped, or ``out`` cannot be written or holds the map of
            another drive.
    """
    from datagen.pipeline import MapRequest, MapSettings, map_drive
    from lanenet.cli.map import check_same_drive
    from lanenet.cli.shared import console
    from lanenet.geometry.lane import check_lane_width

    check_lane_width(float(lane_width_cm))
    settings = MapSettings() if config is None else _settings(MapSettings, config)
    request = MapRequest(
        Path(drive),
        float(lane_width_cm),
        _camera_path(camera),
        refine_camera,
        _car_length("wheelbase_cm", wheelbase_cm),
        _car_length("camera_height_cm", camera_height_cm),
        _float(tape_width_cm),
        _frames(frames),
    )
    if not force:
        check_same_drive(Path(out), Path(drive))
    with console.progress_bar("map") as progress:
        return map_drive(request, settings, Path(out), progress)


def label(
    map_folder: str | Path,
    out: str | Path,
    *,
    force: bool = False,
    colour_weight: float | None = None,
) -> Report:
    """Project a map's lane lines into each frame: six labels per frame, as ``lanenet label``.

    Shows its progress on stderr. Needs ``lanenet[data]``.

    Args:
        map_folder: What :func:`map` wrote.
        out: Label set to write (``.parquet``), with a report (``.json``) and a picture (``.png``) beside it.
        force: Label a rejected map, too.
        colour_weight: Weight of colour beside brightness when edges are found, 0 to 1; None takes the usual.

    Returns:
        ``lines`` for people and ``figures`` for programs.

    Raises:
        ConfigError: If ``out`` is no Parquet file, or one of the map's own files.
        TrackingLostError: If the map was rejected, or no frame can be labelled.
        LanenetError: If the map cannot be read or ``out`` cannot be written.
    """
    from lanenet.cli import label as command
    from lanenet.cli.shared.options import held_to_the_end

    with held_to_the_end():
        return command.label_set(Path(map_folder), Path(out), force, colour_weight)


def train(
    source: Settings | Mapping[str, Any] | str | Path | Sequence[str | Path],
    *overrides: str,
    name: str | None = None,
    lane_width_cm: int | float | None = None,
    camera: str | Path | None = None,
    wheelbase_cm: int | float | None = None,
    camera_height_cm: int | float | None = None,
    tape_width_cm: int | float | None = None,
    frames: tuple[int, int] | None = None,
    marking_cm: int | float | None = None,
    force: bool = False,
) -> Path:
    """Train on one's own drives, or do all that a config needs, as ``lanenet train``.

    Makes the maps and labels that are needed, trains, evaluates and exports. Shows its progress on stderr
    and prints verdicts and a table. What is there already is used, and a run that was interrupted resumes.
    Starts processes, so a script calls it below ``if __name__ == "__main__":``, as Python's
    ``multiprocessing`` asks for. Needs ``lanenet[train]``.

    Args:
        source: Drive, tub or video, a folder of them, a map, a label set, or several of these; or a config:
            its file (``.yaml``), as ``configs/finetune.yaml``, or its settings.
        overrides: Settings that replace those of the config, given or made, as ``learn.epochs=5``.
        name: Of the network of one's own drives, which is written to ``checkpoints/NAME``. A config has a key
            for this and the next six.
        lane_width_cm: Between the middles of the lane's two lines, for a drive that is to be mapped.
        camera: Camera file, or an earlier map of the same car.
        wheelbase_cm: Distance between the car's axles.
        camera_height_cm: Height of the lens above the road.
        tape_width_cm: Width of the tape: checks the lane width.
        frames: First and last number of the frames to map; None for all of them.
        marking_cm: Width of the tape for the detectors that it is compared with.
        force: Replace a network of that name that was trained on other drives, too.

    Returns:
        The checkpoint's folder, which :func:`load` opens.

    Raises:
        ConfigError: If a setting is wrong, the name or a lane width is missing, or a config is given with
            what it has keys for.
        LanenetError: If a drive cannot be mapped or its map was rejected, or if the checkpoint was trained
            on other drives or is being written by another run.
    """
    from lanenet.cli import train as command
    from lanenet.cli.shared.options import held_to_the_end
    from lanenet.cli.shared.own_drive import Measured, is_config
    from lanenet.errors import ConfigError
    from lanenet.geometry.lane import check_lane_width

    width_cm = _float(lane_width_cm)
    if width_cm is not None:
        check_lane_width(width_cm)
    measured = Measured(
        width_cm,
        _camera_path(camera),
        _car_length("wheelbase_cm", wheelbase_cm),
        _car_length("camera_height_cm", camera_height_cm),
        _float(tape_width_cm),
        _frames(frames),
    )
    paths = _paths(source)
    for word in overrides:
        if not isinstance(word, str):
            raise ConfigError(f"{word!r}: expected a setting as a text, as 'learn.epochs=5'")
    with held_to_the_end():
        if paths is None or is_config(paths[0]):
            given = [*([] if name is None else ["name"]), *measured.given]
            if given:
                raise ConfigError(f"{given[0]}=...: is for drives, but a config has a key for it")
            config = source if paths is None else paths[0]
            settings = _settings(command.run_settings_schema(), config, overrides)  # type: ignore[arg-type]
        elif name is None:
            raise ConfigError(
                f"expected a name for the network, as in lanenet.train({str(paths[0])!r}, "
                f"name={paths[0].resolve().stem!r})"
            )
        else:
            settings = command.own_settings(name, paths, measured, overrides, force)
        return command.train_run(settings, _float(marking_cm), force)


def detect(
    source: str | Path,
    out: str | Path,
    *,
    model: str | Path | None = None,
    detector: str | None = None,
    camera: str | Path | None = None,
    video: str | Path | None = None,
    lane_width_cm: int | float | None = None,
    marking_cm: int | float | None = None,
    any_camera: bool = False,
    frames: tuple[int, int] | None = None,
    skip_unreadable: bool = False,
    config: str | Path | None = None,
    mask: str | Path | None = None,
) -> DetectReport:
    """Run a detector over a photo, a video, a drive or a tub, and write what it finds, as ``lanenet detect``.

    Shows its progress on stderr. :func:`load` gives a network as a function of one image.

    Args:
        source: Photo, folder of photos, video, drive, tub, or a map of one.
        out: Table to write (``.parquet`` or ``.csv``).
        model: Checkpoint folder or ONNX file of a network, or ``hf:owner/name``.
        detector: ``network``, ``lane-filter``, ``hough`` or ``painter``; a model alone means the network.
        camera: Camera file, or a map of the same car; None takes that of the drive or map.
        video: Annotated video to write (``.mp4``); of one photo a picture (``.png``, ``.jpg``).
        lane_width_cm: Between the middles of the lane's two lines; None takes the drive's.
        marking_cm: Width of the tape.
        any_camera: Accept a camera that the model was not trained with.
        frames: First and last number of the frames; None for all of them.
        skip_unreadable: Give a frame that cannot be read an empty row.
        config: File with the settings of the detector.
        mask: ``auto``, or a PNG that is black except on the car itself.

    Returns:
        Counts, timings and problems.

    Raises:
        LanenetError: If the source, the model or the camera cannot be used, or an output cannot be written.
    """
    from lanenet.cli import detect as command
    from lanenet.cli.shared.options import held_to_the_end
    from lanenet.data.hub import pulled
    from lanenet.geometry.lane import check_lane_width

    width_cm = _float(lane_width_cm)
    if width_cm is not None:
        check_lane_width(width_cm)
    asked = command.Asked(
        Path(source),
        Path(out),
        model=None if model is None else pulled(model),
        detector=detector,
        camera=_camera_path(camera),
        video=None if video is None else Path(video),
        lane_width_cm=width_cm,
        marking_cm=_float(marking_cm),
        any_camera=any_camera,
        frames=_frames(frames),
        skip_unreadable=skip_unreadable,
        config=None if config is None else Path(config),
        mask=None if mask is None else str(mask),
    )
    with held_to_the_end():
        return command.detect_lanes(asked)[0]


def _paths(source: object) -> list[Path] | None:
    """Return the paths of drives, or of a config; None for the settings of a config."""
    from collections.abc import Iterable, Mapping

    from lanenet.config import Settings
    from lanenet.errors import ConfigError

    if isinstance(source, Settings | Mapping):
        return None
    if isinstance(source, str | Path):
        return [Path(source)]
    paths = [Path(path) for path in source] if isinstance(source, Iterable) else []
    if not paths:
        raise ConfigError(f"{source!r}: expected drives, maps or label sets, or a config")
    return sorted(paths) if isinstance(source, set | frozenset) else paths


def _camera_path(camera: object) -> Path | None:
    """Return where a camera is to be read; a camera itself is refused, since maps write down the path."""
    from lanenet.errors import ConfigError

    if camera is None or isinstance(camera, str | Path):
        return None if camera is None else Path(camera)
    raise ConfigError(
        f"camera=...: expected the path of a camera file or of a map, found {type(camera).__name__}; "
        "lanenet.data.camera_file.write_camera writes a camera to a file"
    )


def _frames(frames: Any) -> tuple[int, int] | None:
    """Check the numbers of a first and a last frame."""
    from operator import index

    from lanenet.errors import ConfigError

    if frames is None:
        return None
    try:
        first, last = (index(number) for number in frames)
    except (TypeError, ValueError):
        first, last = 0, -1
    if not 0 <= first <= last:
        raise ConfigError(f"frames={frames!r}: expected the first and the last number, as (700, 999)")
    return first, last


def _car_length(name: str, value: int | float | None) -> float | None:
    """Check a length of the car, as its option does."""
    from lanenet.cli.shared.options import check_car_length
    from lanenet.errors import ConfigError

    if value is not None:
        try:
            check_car_length(float(value))
        except ConfigError as error:
            raise ConfigError(f"{name}={error}") from None
    return _float(value)


def _float(value: int | float | None) -> float | None:
    """A length as the package has it; people write 40 as well as 40.0."""
    return None if value is None else float(value)


def _settings(
    schema: type[SettingsT],
    config: Settings | Mapping[str, Any] | str | Path,
    overrides: Sequence[str] = (),
) -> SettingsT:
    """Check settings, whether they are a file, plain values or settings already."""
    from lanenet.config import Settings, apply_overrides, check_settings, load_settings

    if isinstance(config, str | Path):
        return load_settings(schema, Path(config), list(overrides))
    plain = config.model_dump() if isinstance(config, Settings) else dict(config)
    return check_settings(schema, apply_overrides(plain, list(overrides)), "config")
