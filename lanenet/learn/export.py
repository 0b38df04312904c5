"""From weights to one self-contained ONNX file that says what it is, as floating point or as INT8."""

from __future__ import annotations

import contextlib
import hashlib
import io
import logging
import time
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
import onnx
import onnxruntime
import torch
from jaxtyping import UInt8
from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from lanenet.config import load_settings, read_yaml
from lanenet.data.files import atomic_file, write_bytes, write_json
from lanenet.data.label_set import read_labels
from lanenet.errors import CheckpointError, ConfigError, ModelMismatchError
from lanenet.learn.config import LearnSettings
from lanenet.learn.network import DeployedLaneNet, LaneNet
from lanenet.outputs import restore_output
from lanenet.perception.edges.raster import MIDDLE, STEPS
from lanenet.perception.network.model_file import (
    BATCH_NAME,
    HASH_NAME,
    INPUT_NAME,
    LOG_SHARE_NAME,
    MARKER_NAME,
    MODEL_NAME,
    OUTPUT_NAMES,
    SELF_TEST_NAME,
    SELF_TEST_TOLERANCE,
    WIDTH_NAME,
    ModelMeta,
    answers_of,
    is_model,
    open_model,
    sealed,
    self_test,
    without_model,
)
from lanenet.reading import first_line, is_regular, parsing, read_image

#: What onnxruntime 1.17, the oldest that the package accepts, can read (it stops at opset 20).
OPSET = 18
IR_VERSION = 9
#: Largest difference between PyTorch and onnxruntime, [cm]; parabolas and angles are much smaller numbers.
#: Chosen: far below any error that matters, and 30 times what is found.
TOLERANCE = 1e-3
#: Lane widths that a network is given in the check, beside none at all: unknown, narrow and wide.
_CHECKED_WIDTHS_CM = (0.0, 30.0, 60.0)
#: What an exported network does to a raster's bytes before its first layer.
_DECODING = ("Cast", "Slice", "Sub", "Mul", "Concat")
#: What does all of it.
_DECODE = "DequantizeLinear"
#: Rasters of the check at a time; bounds the memory.
_BATCH = 256

CHECKPOINT_FORMAT = "lanenet-checkpoint/1"
CONFIG_NAME = "config.yaml"
WEIGHTS_NAME = "weights.safetensors"
RASTERS_NAME = "check_rasters.png"
CALIBRATION_NAME = "calibration_rasters.png"
INT8_NAME = "model-int8.onnx"
#: Largest RMS change of the points by quantisation. Chosen: a tenth of a good network's RMSE.
TOLERANCE_CM = 0.05
#: Largest difference of a quantised model's answer on another computer, [cm]. Chosen: five times what
#: quantisation may change, since a processor rounds eight bits in its own way.
INT8_SELF_TEST_TOLERANCE = 0.25
#: Timed runs of each model, and untimed ones before them. Chosen: well below a second in all.
_ROUNDS, _WARM_UP = 200, 20


def export_onnx(
    network: LaneNet, meta: ModelMeta, rasters: UInt8[np.ndarray, "n p r c"], path: Path
) -> float:
    """Write a network as ONNX, after a check against PyTorch.

    The file appears at ``path`` only if onnxruntime answers as PyTorch does.

    Args:
        network: Trained network.
        meta: Its description, kept in the file.
        rasters: Real rasters for the check.
        path: File to write.

    Returns:
        The largest difference of any output on the rasters, [cm] or smaller units.

    Raises:
        CheckpointError: If there is no raster, or the answers differ by more than ``TOLERANCE``.
    """
    if not len(rasters):
        raise CheckpointError(f"{path}: no raster to check the export with, expected at least one")
    deployed = DeployedLaneNet(network).eval()
    model = _to_onnx(deployed, meta)
    with atomic_file(path) as temporary:
        try:
            session = _session(model)
            difference = _largest_difference(deployed, session, rasters)
            if not difference <= TOLERANCE:
                raise CheckpointError(
                    f"{path}: onnxruntime differs from PyTorch by {difference:.2g}, "
                    f"expected at most {TOLERANCE:g}"
                )
            _write_tested(temporary, model, session, rasters)
        except ModelMismatchError as error:
            raise CheckpointError(f"{path}: the exported model cannot be used ({error})") from None
    return difference


def export_checkpoint(
    checkpoint: Path, out: Path | None = None, labels: Sequence[Path] = ()
) -> tuple[Path, int, float]:
    """Export the weights of a checkpoint folder.

    Args:
        checkpoint: Folder that :func:`lanenet.learn.train.train` wrote.
        out: File to write; None replaces the folder's ``model.onnx``.
        labels: Label sets whose rasters are checked beside those in the folder.

    Returns:
        The file, the number of rasters of the check, and the largest difference of any output on them, [cm]
        or smaller units.

    Raises:
        CheckpointError: If a file of the folder is missing or does not fit, a label set has another window,
            or the check fails.
        LabelFormatError: If a label set cannot be used.
    """
    path = checkpoint / MODEL_NAME if out is None else out
    network, meta = read_network(checkpoint)
    rasters = [read_rasters(checkpoint / RASTERS_NAME, meta)]
    for file in labels:
        label_set = read_labels(file)
        if label_set.meta.window != meta.window:
            raise CheckpointError(f"{file}: made for {label_set.meta.window}, expected {meta.window}")
        rasters.append(np.stack([label_set.raster(i)[: meta.planes] for i in range(len(label_set))]))
    every = np.concatenate(rasters)
    return path, len(every), export_onnx(network, meta, every, path)


def write_weights(path: Path, network: LaneNet, meta: ModelMeta) -> None:
    """Write weights, their hash and their description as safetensors."""
    tensors = {name: value.detach().cpu().contiguous() for name, value in network.state_dict().items()}
    write_bytes(path, save(tensors, metadata=meta.to_properties() | {HASH_NAME: _hash_weights(tensors)}))


def _hash_weights(tensors: dict[str, torch.Tensor]) -> str:
    total = hashlib.sha256()
    for name in sorted(tensors):
        total.update(f"{name} {tuple(tensors[name].shape)} ".encode())
        total.update(tensors[name].numpy().tobytes())
    return total.hexdigest()


def read_network(checkpoint: Path) -> tuple[LaneNet, ModelMeta]:
    """Build the network of a checkpoint folder.

    Raises:
        CheckpointError: If a file is missing, damaged, cannot be read or is of another format version, or the
            weights do not fit the config.
    """
    restore_output(checkpoint)
    if not checkpoint.is_dir():
        found = "is a file" if checkpoint.exists() else "no such folder"
        raise CheckpointError(f"{checkpoint}: {found}, expected a checkpoint folder")
    # A checkpoint without its config or without its weights is named below.
    if not is_model(checkpoint) and not any((checkpoint / n).is_file() for n in (CONFIG_NAME, WEIGHTS_NAME)):
        raise CheckpointError(f"{checkpoint}: expected a checkpoint: {without_model(checkpoint)}")
    marker = checkpoint / MARKER_NAME
    try:
        # A run's own folder has no marker.
        if marker.is_file() and (form := read_yaml(marker).get("format")) != CHECKPOINT_FORMAT:
            raise CheckpointError(f"{marker}: format is {form!r}, expected {CHECKPOINT_FORMAT!r}")
        settings = load_settings(LearnSettings, checkpoint / CONFIG_NAME)
    except ConfigError as error:
        raise CheckpointError(str(error)) from None
    path = checkpoint / WEIGHTS_NAME
    if not is_regular(path):
        raise CheckpointError(f"{path}: no such file; was the training finished?")
    try:
        with safe_open(path, framework="pt") as file:
            properties = file.metadata() or {}
            state = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
        # Weights of earlier versions have no hash.
        if properties.get(HASH_NAME, "") not in ("", _hash_weights(state)):
            raise CheckpointError(
                f"{path}: was damaged or changed, expected the weights as they were trained"
            )
        meta = ModelMeta.from_properties(properties, str(path))
    except (SafetensorError, OSError) as error:
        raise CheckpointError(f"{path}: cannot be read as safetensors ({error})") from None
    except ModelMismatchError as error:
        raise CheckpointError(str(error)) from None
    try:
        with parsing(f"{path}: weights do not fit {checkpoint / CONFIG_NAME}", CheckpointError):
            network = LaneNet(settings.network, meta.window.rows, meta.window.columns)
            network.load_state_dict(state)
    except RuntimeError as error:
        detail = " ".join(str(error).split())[:300]
        raise CheckpointError(f"{path}: weights do not fit {checkpoint / CONFIG_NAME} ({detail})") from None
    if not all(bool(torch.isfinite(value).all()) for value in state.values()):
        raise CheckpointError(f"{path}: a weight is not finite")
    return network.eval(), meta


def write_rasters(path: Path, rasters: UInt8[np.ndarray, "n p r c"]) -> None:
    """Write rasters as one tall image, so that a later export can be checked without the data."""
    tall = rasters.reshape(-1, rasters.shape[-1])
    done, png = cv2.imencode(".png", tall)
    if not done:
        raise CheckpointError(f"{path}: the rasters {rasters.shape} cannot be written as an image")
    write_bytes(path, png.tobytes())


def read_rasters(path: Path, meta: ModelMeta) -> UInt8[np.ndarray, "n p r c"]:
    """Read what :func:`write_rasters` wrote.

    Raises:
        CheckpointError: If the image is missing or does not fit the window.
    """
    if not is_regular(path):
        raise CheckpointError(f"{path}: no such file; an export needs its rasters")
    image = read_image(path, CheckpointError, cv2.IMREAD_GRAYSCALE)
    rows, columns = meta.window.rows, meta.window.columns
    if image.shape[1] != columns or image.shape[0] % (meta.planes * rows):
        found = f"{image.shape[0]} x {image.shape[1]}"
        raise CheckpointError(
            f"{path}: found {found}, expected rasters of {meta.planes} x {rows} x {columns}"
        )
    return image.reshape(-1, meta.planes, rows, columns)


@dataclass(frozen=True)
class Int8Report:
    """What quantisation costs and brings on this machine.

    Attributes:
        rms_difference_cm: RMS difference of the points, on validation rasters.
        largest_difference_cm: Largest difference of a point.
        median_ms: Time of one raster, one thread.
        float_median_ms: The same for the original model, timed alternately with it.
        size_bytes: Of the file.
        float_size_bytes: Of the original model.
    """

    rms_difference_cm: float
    largest_difference_cm: float
    median_ms: float
    float_median_ms: float
    size_bytes: int
    float_size_bytes: int

    @property
    def recommended(self) -> bool:
        """True where it is faster and answers within ``TOLERANCE_CM``."""
        return self.median_ms < self.float_median_ms and self.rms_difference_cm <= TOLERANCE_CM

    @property
    def lines(self) -> list[str]:
        """The report for people."""
        verdict = "use it" if self.recommended else f"keep {MODEL_NAME}"
        return [
            f"points change by {self.rms_difference_cm:.3f} cm (RMS), {self.largest_difference_cm:.3f} cm at "
            f"most; at most {TOLERANCE_CM:g} cm (RMS) is accepted",
            f"one raster takes {self.median_ms:.3f} ms, {self.float_median_ms:.3f} ms in floating point",
            f"{self.size_bytes / 1e3:.0f} kB, {self.float_size_bytes / 1e3:.0f} kB in floating point",
            f"on this machine: {verdict}",
        ]


def export_int8(checkpoint: Path, out: Path | None = None) -> tuple[Path, Int8Report]:
    """Quantise the exported model of a checkpoint; the figures are written beside it as JSON.

    Only the convolutions are quantised, with value ranges from training rasters. The fully connected layers
    are not: a point has to be right to 0.1 %, which eight bits cannot hold.

    Args:
        checkpoint: Folder with an exported model and its rasters.
        out: File to write; None writes ``model-int8.onnx`` into the folder.

    Returns:
        The file and its report.

    Raises:
        CheckpointError: If a file of the folder is missing or does not fit.
        ModelMismatchError: If its model cannot be used.
    """
    source = checkpoint / MODEL_NAME
    path = checkpoint / INT8_NAME if out is None else out
    session, meta = open_model(source)
    rasters = read_rasters(checkpoint / CALIBRATION_NAME, meta)
    checks = read_rasters(checkpoint / RASTERS_NAME, meta)
    described = path.with_suffix(".json")
    with atomic_file(path) as temporary, atomic_file(described) as report_file, _quiet():
        original = onnx.load(source)
        _decode_in_steps(original.graph)
        quantize_static(
            original,
            temporary,
            _Rasters(rasters),
            quant_format=QuantFormat.QDQ,
            op_types_to_quantize=["Conv"],
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            per_channel=True,
        )
        # The quantiser drops the description.
        model = onnx.load(temporary)
        onnx.helper.set_model_props(model, meta.to_properties())
        small = _write_tested(temporary, model, _session(model), checks, INT8_SELF_TEST_TOLERANCE)
        size_bytes = temporary.stat().st_size
        names = ["points_cm"]
        off = small.run(names, {INPUT_NAME: checks})[0] - session.run(names, {INPUT_NAME: checks})[0]
        times_ms = np.empty((_WARM_UP + _ROUNDS, 2))
        # Alternately, so that other load on the machine slows both.
        for i, which in np.ndindex(times_ms.shape):
            begin = time.perf_counter()
            (small, session)[which].run(names, {INPUT_NAME: checks[i % len(checks)][None]})
            times_ms[i, which] = 1e3 * (time.perf_counter() - begin)
        small_ms, float_ms = np.median(times_ms[_WARM_UP:], axis=0).tolist()
        largest_cm, float_bytes = float(np.abs(off).max()), source.stat().st_size
        report = Int8Report(
            float(np.sqrt(np.mean(off**2))), largest_cm, small_ms, float_ms, size_bytes, float_bytes
        )
        write_json(report_file, asdict(report) | {"recommended": report.recommended})
    return path, report


def _session(model: onnx.ModelProto) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    try:
        return onnxruntime.InferenceSession(
            model.SerializeToString(), options, providers=["CPUExecutionProvider"]
        )
    except Exception as error:  # onnxruntime has no common base class of its own
        raise ModelMismatchError(f"onnxruntime: {first_line(error)}") from None


def _write_tested(
    path: Path,
    model: onnx.ModelProto,
    session: onnxruntime.InferenceSession,
    rasters: UInt8[np.ndarray, "n p r c"],
    tolerance: float = SELF_TEST_TOLERANCE,
) -> onnxruntime.InferenceSession:
    """Write a model with its self-test and its hash; open it as the car does.

    Raises:
        ModelMismatchError: If it cannot be used.
    """
    # The raster with the most edges: its answer depends on the most weights.
    fullest = rasters[int(np.argmax(np.count_nonzero(rasters[:, 0], axis=(1, 2))))]
    entry = model.metadata_props.add()
    entry.key, entry.value = SELF_TEST_NAME, self_test(session, fullest, tolerance)
    path.write_bytes(sealed(model.SerializeToString()))
    return open_model(path)[0]


def _to_onnx(deployed: DeployedLaneNet, meta: ModelMeta) -> onnx.ModelProto:
    example = [torch.zeros(2, meta.planes, meta.window.rows, meta.window.columns, dtype=torch.uint8)]
    inputs, shapes = [INPUT_NAME], [{0: torch.export.Dim(BATCH_NAME, min=1)}]
    if meta.takes_width:
        # Two, not one: the exporter takes a dimension of one for a constant.
        example.append(torch.zeros(2))
        inputs.append(WIDTH_NAME)
        shapes.append(shapes[0])
    with _quiet():
        program = torch.onnx.export(
            deployed,
            tuple(example),
            dynamo=True,
            verbose=False,
            external_data=False,
            opset_version=OPSET,
            input_names=inputs,
            output_names=[*OUTPUT_NAMES, *([] if deployed.network.bins_cm is None else [LOG_SHARE_NAME])],
            dynamic_shapes=tuple(shapes),
        )
    if program is None:
        raise CheckpointError("torch.onnx.export returned None, expected a program")
    model: onnx.ModelProto = program.model_proto
    # The exporter writes source lines and folders of this machine on every node; IR 9 does not know them.
    for node in model.graph.node:
        node.ClearField("doc_string")
        if "metadata_props" in node.DESCRIPTOR.fields_by_name:
            node.ClearField("metadata_props")
    for owner in (model.graph, *model.graph.input, *model.graph.output, *model.graph.initializer):
        if "metadata_props" in owner.DESCRIPTOR.fields_by_name:
            owner.ClearField("metadata_props")
    del model.graph.value_info[:]
    _decode_at_once(model.graph, meta.planes)
    if meta.takes_width:
        _make_optional(model.graph)
    model.ir_version = IR_VERSION
    model.producer_name = "lanenet"
    model.producer_version = ""
    onnx.helper.set_model_props(model, meta.to_properties())
    onnx.checker.check_model(model)
    return model


def _decode_at_once(graph: onnx.GraphProto, planes: int) -> None:
    """Make one node of those that turn bytes into the network's input: the same numbers, in one pass.

    They take a fifth of the time of a small network where each goes through all planes.
    """
    decoded, nodes = {INPUT_NAME}, []
    for node in graph.node:
        if node.op_type in _DECODING and decoded & set(node.input):
            decoded |= set(node.output)
            nodes.append(node)
            if node.op_type == ("Mul" if planes == 1 else "Concat"):
                break
    scales = np.array([1.0 / 255.0] + [1.0 / STEPS] * (planes - 1), np.float32)
    zeros = np.array([0] + [MIDDLE] * (planes - 1), np.uint8)
    inputs = _add_constants(graph, plane_scales=scales, plane_zeros=zeros)
    at_once = onnx.helper.make_node(
        _DECODE, [INPUT_NAME, *inputs], [nodes[-1].output[0]], name="decode", axis=1
    )
    _replace(graph, nodes, [at_once])


def _decode_in_steps(graph: onnx.GraphProto) -> None:
    """Undo :func:`_decode_at_once`, whose node the quantiser would take for a quantised network's."""
    # Files of earlier versions decode in steps.
    for node in [each for each in graph.node if each.op_type == _DECODE and INPUT_NAME in each.input]:
        constants = {value.name: onnx.numpy_helper.to_array(value) for value in graph.initializer}
        scales, zeros = (constants[name].astype(np.float32).reshape(1, -1, 1, 1) for name in node.input[1:])
        scales_name, zeros_name = _add_constants(graph, scales=scales, zeros=zeros)
        steps = [
            onnx.helper.make_node("Cast", [INPUT_NAME], ["values"], to=onnx.TensorProto.FLOAT),
            onnx.helper.make_node("Sub", ["values", zeros_name], ["shifted"]),
            onnx.helper.make_node("Mul", ["shifted", scales_name], [node.output[0]]),
        ]
        _replace(graph, [node], steps)


def _add_constants(graph: onnx.GraphProto, **constants: np.ndarray) -> tuple[str, ...]:
    graph.initializer.extend(onnx.numpy_helper.from_array(value, name) for name, value in constants.items())
    return tuple(constants)


def _replace(graph: onnx.GraphProto, old: Sequence[onnx.NodeProto], new: Sequence[onnx.NodeProto]) -> None:
    """Put nodes, the first of a graph, in the place of others; drop the constants that only those used."""
    nodes = [*new, *(node for node in graph.node if node not in old)]
    used = {name for node in nodes for name in node.input}
    constants = [value for value in graph.initializer if value.name in used]
    del graph.node[:], graph.initializer[:]
    graph.node.extend(nodes)
    graph.initializer.extend(constants)


def _make_optional(graph: onnx.GraphProto) -> None:
    """Make the lane width optional; left out, it is unknown: 0."""
    width = next(value for value in graph.input if value.name == WIDTH_NAME)
    # One for all rasters, or one for each.
    width.type.tensor_type.shape.dim[0].dim_param = "w"
    graph.initializer.append(onnx.numpy_helper.from_array(np.zeros(1, np.float32), WIDTH_NAME))


def _largest_difference(
    deployed: DeployedLaneNet, session: onnxruntime.InferenceSession, rasters: UInt8[np.ndarray, "n p r c"]
) -> float:
    off = []
    widths_cm = _CHECKED_WIDTHS_CM if deployed.network.width_bias is not None else ()
    feeds: list[dict[str, np.ndarray]] = [{}, *({WIDTH_NAME: np.array([w], np.float32)} for w in widths_cm)]
    for begin in range(0, len(rasters), _BATCH):
        some = rasters[begin : begin + _BATCH]
        for given in feeds:
            with torch.inference_mode():
                expected = deployed(torch.from_numpy(some), *(torch.from_numpy(w) for w in given.values()))
            found = session.run(answers_of(session), {INPUT_NAME: some} | given)
            off += [np.max(np.abs(np.asarray(f) - e.numpy())) for f, e in zip(found, expected, strict=True)]
    # Not Python's max(), which ignores NaN.
    return float(np.max(off))


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Silence the exporters: prints, log lines, warnings."""
    previous = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with (
            warnings.catch_warnings(),
            contextlib.redirect_stdout(io.StringIO()),
            contextlib.redirect_stderr(io.StringIO()),
        ):
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(previous)


class _Rasters(CalibrationDataReader):  # type: ignore[misc]
    """Feeds the quantiser one raster after the other."""

    def __init__(self, rasters: UInt8[np.ndarray, "n p r c"]) -> None:
        self._rest: Iterator[np.ndarray] = iter(rasters)

    def get_next(self) -> dict[str, np.ndarray] | None:
        """Return the next raster by its input's name, or None."""
        raster = next(self._rest, None)
        return None if raster is None else {INPUT_NAME: raster[None]}
