"""Model files: finding one, reading its metadata, and checking that the metadata match the graph.

Whether a model fits a camera is checked in :mod:`lanenet.perception.network.detector`.

Wherever a model is expected, its checkpoint folder will do.

A model file ends with a hash of all that goes before it, and its description holds a raster with the answer
that it got where the file was made. Both are checked whenever it is opened: a damaged weight still answers,
and another computer may compute otherwise.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import json
import math
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from jaxtyping import UInt8
from pydantic import Field

from lanenet.config import Settings, check_settings
from lanenet.errors import ConfigError, ModelMismatchError
from lanenet.geometry.birdseye import BirdseyeWindow, WindowFile
from lanenet.geometry.lane import N_POINTS, POINT_NAMES, ROWS_CM
from lanenet.outputs import restore_output
from lanenet.perception.edges.raster import PLANES
from lanenet.perception.edges.road import PerceptionSettings
from lanenet.reading import MEBIBYTE, first_line, is_regular, parsing, read_bytes

if TYPE_CHECKING:
    import onnxruntime

#: A checkpoint's ONNX file, which the car runs.
MODEL_NAME = "model.onnx"
#: Marks a folder as a checkpoint.
MARKER_NAME = "checkpoint.yaml"
#: Folders listed in an error; chosen: about two lines of a terminal.
_MOST_NAMED = 8

FORMAT = "lanenet-model/3"
INPUT_NAME = "raster"
#: Optional input for the lane's width, [cm]; 0 is unknown.
WIDTH_NAME = "lane_width_cm"
#: The dimension of inputs and outputs that counts the rasters.
BATCH_NAME = "n"
OUTPUT_NAMES = ("points_cm", "sigma_cm", "presence", "parabolas", "centre_cm", "steering_rad")
#: Optional output: log probabilities of places from the left to the right end of the window, of each point.
LOG_SHARE_NAME = "log_share"
#: Stands for the cameras of a model that was trained with many.
ANY_CAMERA = "any"
#: Error of a lane width that was measured on the floor; chosen: half a centimetre of a ruler's reading.
_WIDTH_SLACK_CM = 0.5

#: Of a model file. Chosen: AlexNet, the largest network here, has 230 MB.
_MAX_MODEL = 1024 * MEBIBYTE
#: Keys of the description: the answer to a raster, and the hash at the end of the file.
SELF_TEST_NAME, HASH_NAME = "self_test", "sha256"
_REMEDY = "export it again (lanenet export CHECKPOINT), or fetch it again"
#: Largest difference of an answer from that of the computer that exported the model, [cm] and smaller units.
#: Measured: 4e-6 cm between x86-64 and 64-bit Arm; chosen: as the export's own check.
SELF_TEST_TOLERANCE = 1e-3

_UNITS = {
    "points_cm": "cm",
    "sigma_cm": "cm",
    "presence": "probability",
    "parabolas": "1/cm, 1, cm",
    "centre_cm": "cm",
    "steering_rad": "rad",
}
_SIGNS = {"x": "positive right", "y": "positive ahead", "steering_rad": "positive left"}


def is_model(path: Path) -> bool:
    """Tell whether a path stands for a model: an ONNX file by its name, or a checkpoint folder."""
    restore_output(path)
    return _is_checkpoint(path) or path.suffix.lower() == ".onnx"


def find_model(path: Path) -> Path:
    """Return the model file that a path stands for: the path itself, or the model of a checkpoint folder.

    Raises:
        ModelMismatchError: If there is no such file, or none in the folder; names the folders in it that have
            one.
    """
    restore_output(path)
    found = path / MODEL_NAME if path.is_dir() else path
    if is_regular(found):
        return found
    if _is_checkpoint(path):
        raise ModelMismatchError(f"{path}: no {MODEL_NAME} in it; make one with: lanenet export {path}")
    if path.is_dir():
        raise ModelMismatchError(f"{path}: expected a model: {without_model(path)}")
    raise ModelMismatchError(f"{path}: no such file, expected an ONNX model or a checkpoint folder")


def without_model(folder: Path) -> str:
    """Say that a folder is no checkpoint, and which of its own folders are."""
    there = sorted(child.name for child in folder.iterdir() if _is_checkpoint(child))
    more = f" and {len(there) - _MOST_NAMED} more" if len(there) > _MOST_NAMED else ""
    hint = f"; of its folders these do: {', '.join(there[:_MOST_NAMED])}{more}" if there else ""
    return f"the folder holds neither {MODEL_NAME} nor {MARKER_NAME}{hint}"


def _is_checkpoint(path: Path) -> bool:
    return any((path / name).is_file() for name in (MODEL_NAME, MARKER_NAME))


@dataclass(frozen=True)
class ModelMeta:
    """What a model file says about itself.

    Attributes:
        window: Bird's-eye window of its rasters.
        camera_hashes: Of the cameras whose frames it was trained on; ``any`` if it was trained for every
            calibrated camera.
        wheelbase_cm: Of the car that it was trained on.
        lane_width_cm: Mean lane width of its training data, between the middles of the markings.
        training_hash: Hash of the contents of its training files.
        rmse_cm: Error of each point on validation frames; NaN where it was not measured.
        reference: What the errors were measured against: ``truth``, ``map`` or ``map and truth``.
        perception: How the edge points of its rasters were found.
        lane_width_range_cm: The narrowest and the widest lane of its training data; None if all had the mean
            width.
        takes_width: The network has an input for the lane's width beside the raster.
        planes: How many planes of a raster it sees, see :data:`lanenet.perception.edges.raster.PLANES`.
    """

    window: BirdseyeWindow
    camera_hashes: tuple[str, ...]
    wheelbase_cm: float
    lane_width_cm: float
    training_hash: str
    rmse_cm: tuple[float, ...]
    reference: str
    perception: PerceptionSettings = field(default_factory=PerceptionSettings)
    lane_width_range_cm: tuple[float, float] | None = None
    takes_width: bool = False
    planes: int = 1

    @property
    def any_camera(self) -> bool:
        """True if the model was trained for every calibrated camera."""
        return ANY_CAMERA in self.camera_hashes

    @property
    def widths_cm(self) -> tuple[float, float]:
        """The narrowest and the widest lane of the training data."""
        return self.lane_width_range_cm or (self.lane_width_cm, self.lane_width_cm)

    def check_trained_with(self, camera_hash: str, camera: str, where: str) -> None:
        """Refuse a camera that the model was not trained with.

        Args:
            camera_hash: Of the camera.
            camera: What the error calls it.
            where: Names the model's file in the error.

        Raises:
            ModelMismatchError: Naming both cameras, and what to do.
        """
        if not self.any_camera and camera_hash not in self.camera_hashes:
            raise ModelMismatchError(
                f"{where}: trained with camera {', '.join(self.camera_hashes) or 'unknown'}, but {camera} is "
                f"{camera_hash}; use a model for any camera (checkpoints/general), or train with this camera "
                "(lanenet train); if it is the same lens at the same place, calibrated once more, allow it "
                "(--any-camera, detector.any_camera)"
            )

    def untrained_widths(self, lane_widths_cm: Iterable[float], where: str) -> list[str]:
        """Warn of lanes that are narrower or wider than those of the training data.

        Args:
            lane_widths_cm: Widths that the model will get or see.
            where: Names the model's file in the warning.

        Returns:
            One line; none where the model knows all the widths.
        """
        low, high = self.widths_cm
        least, most = low - _WIDTH_SLACK_CM, high + _WIDTH_SLACK_CM
        others = sorted({width for width in lane_widths_cm if not least <= width <= most})
        if not others:
            return []
        found = " and ".join(f"{width:g}" for width in others)
        known = f"{low:.0f} cm" if high - low < 1.0 else f"{low:.0f} to {high:.0f} cm"
        return [
            f"lane width {found} cm: {where} was trained on lanes of {known}; on other widths it was not "
            "tested"
        ]

    def to_properties(self) -> dict[str, str]:
        """Return the description as the text properties of an ONNX file."""
        errors = [None if math.isnan(v) else v for v in self.rmse_cm]
        return {
            "format": FORMAT,
            "rows_cm": json.dumps(ROWS_CM),
            "points": json.dumps(POINT_NAMES),
            "units": json.dumps(_UNITS),
            "signs": json.dumps(_SIGNS),
            "window": json.dumps(asdict(self.window)),
            "camera_hashes": json.dumps(self.camera_hashes),
            "wheelbase_cm": json.dumps(self.wheelbase_cm),
            "lane_width_cm": json.dumps(self.lane_width_cm),
            "lane_width_range_cm": json.dumps(self.widths_cm),
            "training_hash": self.training_hash,
            "rmse_cm": json.dumps(errors),
            "reference": self.reference,
            "perception": self.perception.model_dump_json(),
            "takes_width": json.dumps(self.takes_width),
            "planes": json.dumps(PLANES[: self.planes]),
        }

    @staticmethod
    def from_properties(properties: Mapping[str, str], where: str) -> ModelMeta:
        """Read the description back.

        Args:
            properties: Text properties of an ONNX file.
            where: Names the file in the error.

        Raises:
            ModelMismatchError: If the format is unknown, a property is missing or unreadable, or the six
                outputs mean something else.
        """
        found = properties.get("format")
        if found != FORMAT:
            what = f"format {found!r}" if found else "no format"
            raise ModelMismatchError(f"{where}: {what}, expected {FORMAT!r}; export the model again")

        def value(key: str) -> Any:
            with parsing(f"{where}: property {key!r} is not JSON", ModelMismatchError):
                if key not in properties:
                    raise ModelMismatchError(f"{where}: property {key!r} is missing")
                return json.loads(properties[key])

        for key, expected in (("rows_cm", list(ROWS_CM)), ("points", list(POINT_NAMES)), ("signs", _SIGNS)):
            if value(key) != expected:
                raise ModelMismatchError(f"{where}: {key} {value(key)}, expected {expected}")
        if (planes := value("planes")) not in (list(PLANES[:1]), list(PLANES)):
            raise ModelMismatchError(
                f"{where}: planes {planes}, expected {list(PLANES)} or the first of them"
            )
        names = (*_MetaFile.model_fields,)
        texts: dict[str, Any] = {key: str(properties.get(key, "")) for key in ("training_hash", "reference")}
        try:
            file = check_settings(
                _MetaFile, {name: value(name) for name in names}, f"{where}: unreadable description"
            )
        except ConfigError as error:
            raise ModelMismatchError(str(error)) from None
        if len(file.rmse_cm) != N_POINTS:
            raise ModelMismatchError(f"{where}: rmse_cm has {len(file.rmse_cm)} values, expected {N_POINTS}")
        shared = {name: getattr(file, name) for name in names}
        errors = tuple(math.nan if v is None else v for v in file.rmse_cm)
        shared |= {"window": file.window.window(), "rmse_cm": errors, "planes": len(planes)}
        return ModelMeta(**texts, **shared)


#: A width of the car or lane; chosen: ten metres.
_Width = Annotated[float, Field(gt=0.0, le=1000.0)]


class _MetaFile(Settings):
    """The description in a file, see :class:`ModelMeta`; without its texts, which are no JSON."""

    window: WindowFile
    camera_hashes: tuple[str, ...]
    wheelbase_cm: _Width
    lane_width_cm: _Width
    rmse_cm: tuple[float | None, ...]
    perception: PerceptionSettings
    lane_width_range_cm: tuple[_Width, _Width]
    takes_width: bool


class _SelfTestFile(Settings):
    """A raster and its answer in a file; see :func:`self_test`."""

    raster: str
    answers: dict[str, tuple[float, ...]]
    # Chosen: above that of eight bits; a larger one would test nothing.
    tolerance: float = Field(ge=0.0, le=1.0)


def self_test(
    session: onnxruntime.InferenceSession,
    raster: UInt8[np.ndarray, "p r c"],
    tolerance: float = SELF_TEST_TOLERANCE,
) -> str:
    """Return the self-test of a model, for its property :data:`SELF_TEST_NAME`.

    Args:
        session: The model.
        raster: A raster from its data, with the planes that it sees.
        tolerance: Largest difference of an answer, [cm] and smaller units, on another computer.
    """
    answers = session.run(OUTPUT_NAMES, {INPUT_NAME: raster[None]})
    data = {
        # JSON and ONNX hold text.
        "raster": base64.b64encode(zlib.compress(raster.tobytes(), 9)).decode(),
        "answers": {
            name: [float(f"{value:.7g}") for value in np.asarray(answer).ravel().tolist()]
            for name, answer in zip(OUTPUT_NAMES, answers, strict=True)
        },
        "tolerance": tolerance,
    }
    return json.dumps(data)


def _run_self_test(
    session: onnxruntime.InferenceSession, text: str, shape: tuple[int, int, int], where: str
) -> None:
    """Refuse a model that answers otherwise than where it was made.

    Raises:
        ModelMismatchError: If the test is unreadable, or an answer differs; names the output.
    """
    cells = math.prod(shape)
    with parsing(f"{where}: property {SELF_TEST_NAME!r}", ModelMismatchError):
        try:
            test = check_settings(_SelfTestFile, json.loads(text), SELF_TEST_NAME)
            packed = zlib.decompressobj().decompress(base64.b64decode(test.raster), cells)
        except (ConfigError, binascii.Error) as error:
            raise ModelMismatchError(f"{where}: {error}") from None
        if len(packed) != cells:
            raise ModelMismatchError(f"{where}: property {SELF_TEST_NAME!r}: no raster of its window")
        raster = np.frombuffer(packed, np.uint8).reshape(1, *shape)
    found = _run(session, OUTPUT_NAMES, raster, where)
    for name, answer in zip(OUTPUT_NAMES, found, strict=True):
        expected = np.array(test.answers.get(name, ()))
        values = np.asarray(answer, np.float64).ravel()
        if values.shape != expected.shape:
            raise ModelMismatchError(
                f"{where}: self-test: {name} has {values.size} values, expected {expected.size}"
            )
        off = np.abs(values - expected)
        # Not ">", which NaN would pass.
        if not (off <= test.tolerance).all():
            raise ModelMismatchError(
                f"{where}: self-test: {name} differs by {float(np.max(off)):.3g} from the answer where the "
                f"model was exported, expected at most {test.tolerance:g}; is onnxruntime sound? {_REMEDY}"
            )


def _run(
    session: onnxruntime.InferenceSession, names: Sequence[str], raster: np.ndarray, where: str
) -> list[Any]:
    try:
        return list(session.run(names, {INPUT_NAME: raster}))
    except Exception as error:  # onnxruntime has no common base class of its own
        raise ModelMismatchError(f"{where}: cannot compute ({first_line(error)})") from None


def sealed(model: bytes) -> bytes:
    """Return the bytes of an ONNX file with their hash at the end.

    The hash is one more entry of the file's properties, as any tool reads them: messages of Protocol Buffers
    can be lengthened at their end.
    """
    return model + _seal(model)


def _seal(model: bytes | memoryview) -> bytes:
    key, value = HASH_NAME.encode(), hashlib.sha256(model).hexdigest().encode()
    entry = b"\x0a%c%b\x12%c%b" % (len(key), key, len(value), value)
    # Field 14 of a model: its properties, texts by key.
    return b"\x72%c%b" % (len(entry), entry)


def _check_seal(data: bytes, where: str) -> None:
    """Refuse a file whose bytes are not those that were written.

    Raises:
        ModelMismatchError: Naming the file, and what to do.
    """
    start = _seal(b"")[: -2 * hashlib.sha256().digest_size]
    at = data.rfind(start)
    # A view: a copy of the largest model would not fit into a small computer.
    if at < 0 or data[at:] != _seal(memoryview(data)[:at]):
        what = "was damaged or changed" if at >= 0 else "has no hash at its end"
        raise ModelMismatchError(f"{where}: {what}, expected a model as lanenet exported it; {_REMEDY}")


def open_model(
    path: Path, threads: int = 1, frames: int | None = None
) -> tuple[onnxruntime.InferenceSession, ModelMeta]:
    """Open a model file and check that it is what its description says.

    Args:
        path: ONNX file that :mod:`lanenet.learn` exported, or its checkpoint folder.
        threads: Threads of the computation.
        frames: Rasters of every run, which is faster for being known; None takes any number.

    Raises:
        ModelMismatchError: If the file is missing, was damaged or is not an ONNX file, its description is of
            another format or does not fit its own inputs and outputs, or it fails its self-test.
    """
    path = find_model(path)
    where, data = str(path), read_bytes(path, ModelMismatchError, _MAX_MODEL)
    _check_seal(data, where)
    session = _new_session(data, where, threads, frames)
    # Property texts that are no UTF-8.
    with parsing(f"{where}: properties", ModelMismatchError):
        properties = session.get_modelmeta().custom_metadata_map
    meta = ModelMeta.from_properties(properties, where)
    _check_graph(session, meta, where)
    if SELF_TEST_NAME not in properties:
        raise ModelMismatchError(f"{where}: property {SELF_TEST_NAME!r} is missing; {_REMEDY}")
    shape = meta.planes, meta.window.rows, meta.window.columns
    _run_self_test(session, properties[SELF_TEST_NAME], shape, where)
    return session, meta


def _new_session(data: bytes, where: str, threads: int, frames: int | None) -> onnxruntime.InferenceSession:
    # A command that runs no network starts without it.
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    if frames is not None:
        options.add_free_dimension_override_by_name(BATCH_NAME, frames)
    try:
        # The bytes, not the path: a model by its path may read further files.
        return onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime has no common base class of its own
        reason = first_line(error)
        raise ModelMismatchError(f"{where}: cannot be opened as an ONNX model ({reason})") from None


def _check_graph(session: onnxruntime.InferenceSession, meta: ModelMeta, where: str) -> None:
    """Refuse a model whose inputs and outputs are not those of its description."""
    inputs = {i.name: (i.type, list(i.shape[1:])) for i in session.get_inputs()}
    shape = meta.planes, meta.window.rows, meta.window.columns
    expected = {INPUT_NAME: ("tensor(uint8)", [*shape])}
    if inputs != expected:
        raise ModelMismatchError(f"{where}: inputs {inputs} do not fit its window, expected {expected}")
    takes_width = WIDTH_NAME in {i.name for i in session.get_overridable_initializers()}
    if takes_width != meta.takes_width:
        has = "has an" if takes_width else "has no"
        raise ModelMismatchError(
            f"{where}: {has} input {WIDTH_NAME}, but its description says takes_width: {meta.takes_width}"
        )
    outputs = {o.name: list(o.shape[1:]) for o in session.get_outputs()}
    if not set(OUTPUT_NAMES) <= set(outputs):
        raise ModelMismatchError(f"{where}: outputs {list(outputs)}, expected {list(OUTPUT_NAMES)}")
    shares = outputs.get(LOG_SHARE_NAME)
    if shares is not None and not (len(shares) == 2 and shares[0] == N_POINTS and isinstance(shares[1], int)):
        raise ModelMismatchError(
            f"{where}: output {LOG_SHARE_NAME} of shape {shares}, expected {N_POINTS} x a number of places"
        )


def answers_of(session: onnxruntime.InferenceSession) -> tuple[str, ...]:
    """Return the outputs that a model has: :data:`OUTPUT_NAMES`, and the shares of places if it has them."""
    there = {output.name for output in session.get_outputs()}
    return (*OUTPUT_NAMES, *({LOG_SHARE_NAME} & there))


def read_model_meta(path: Path) -> ModelMeta:
    """Return what a model file says about itself.

    Raises:
        ModelMismatchError: As :func:`open_model`.
    """
    return open_model(path)[1]
