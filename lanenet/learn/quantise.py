"""The exported network, INT8-quantised: smaller, and on some processors faster."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
from jaxtyping import UInt8
from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static

from lanenet.data.files import atomic_file, write_json
from lanenet.learn.export import CALIBRATION_NAME, RASTERS_NAME, quiet, read_rasters
from lanenet.perception.network.model_file import INPUT_NAME, MODEL_NAME, open_model

INT8_NAME = "model-int8.onnx"
#: Largest RMS change of the points by quantisation. Chosen: a tenth of a good network's RMSE.
TOLERANCE_CM = 0.05
#: Timed runs of each model, and untimed ones before them. Chosen: well below a second in all.
_ROUNDS, _WARM_UP = 200, 20


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
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(path) as temporary, quiet():
        quantize_static(
            onnx.load(source),
            temporary,
            _Rasters(rasters),
            quant_format=QuantFormat.QDQ,
            op_types_to_quantize=["Conv"],
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            per_channel=True,
        )
        model = onnx.load(temporary)
        # The quantiser drops the description.
        onnx.helper.set_model_props(model, meta.to_properties())
        onnx.save(model, temporary)
        small, _ = open_model(temporary)
        report = _compare(session, small, checks, source.stat().st_size, temporary.stat().st_size)
    write_json(path.with_suffix(".json"), asdict(report) | {"recommended": report.recommended})
    return path, report


class _Rasters(CalibrationDataReader):  # type: ignore[misc]
    """Feeds the quantiser one raster after the other."""

    def __init__(self, rasters: UInt8[np.ndarray, "n 1 r c"]) -> None:
        self._rest: Iterator[np.ndarray] = iter(rasters)

    def get_next(self) -> dict[str, np.ndarray] | None:
        """Return the next raster by its input's name, or None."""
        raster = next(self._rest, None)
        return None if raster is None else {INPUT_NAME: raster[None]}


def _compare(
    source: onnxruntime.InferenceSession,
    small: onnxruntime.InferenceSession,
    rasters: UInt8[np.ndarray, "n 1 r c"],
    source_bytes: int,
    small_bytes: int,
) -> Int8Report:
    names = ["points_cm"]
    off = small.run(names, {INPUT_NAME: rasters})[0] - source.run(names, {INPUT_NAME: rasters})[0]
    times_ms: dict[int, list[float]] = {0: [], 1: []}
    # Alternately, so that other load on the machine slows both.
    for i in range(_WARM_UP + _ROUNDS):
        raster = rasters[i % len(rasters)][None]
        for which, session in enumerate((source, small)):
            begin = time.perf_counter()
            session.run(names, {INPUT_NAME: raster})
            if i >= _WARM_UP:
                times_ms[which].append(1e3 * (time.perf_counter() - begin))
    return Int8Report(
        rms_difference_cm=float(np.sqrt(np.mean(off**2))),
        largest_difference_cm=float(np.abs(off).max()),
        median_ms=float(np.median(times_ms[1])),
        float_median_ms=float(np.median(times_ms[0])),
        size_bytes=small_bytes,
        float_size_bytes=source_bytes,
    )
