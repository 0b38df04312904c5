import base64
import json
import math
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from lanenet.errors import CalibrationError, ConfigError, ModelMismatchError
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.camera import Camera, Mounting
from lanenet.learn.config import NetworkSettings
from lanenet.learn.export import export_onnx
from lanenet.learn.network import new_network
from lanenet.perception import estimate
from lanenet.perception.edges.raster import fill_raster, new_raster
from lanenet.perception.edges.road import PerceptionSettings, RoadEdgeExtractor
from lanenet.perception.estimate import DetectorInputs, LaneMemory
from lanenet.perception.network.detector import NetworkDetector
from lanenet.perception.network.lane.filter import LaneFilter
from lanenet.perception.network.model_file import HASH_NAME, ModelMeta, read_model_meta, sealed
from lanenet.perception.registry import build_detector

torch.set_num_threads(1)

WINDOW = BirdseyeWindow(left_cm=-48.0, near_cm=0.0, cell_cm=3.0, rows=24, columns=32)
CAMERA = Camera(
    model="pinhole",
    width=160,
    height=120,
    K=np.array([[80.0, 0.0, 79.5], [0.0, 80.0, 59.5], [0.0, 0.0, 1.0]]),
    D=np.zeros(5),
    mounting=Mounting(height_cm=15.0, pitch_down_rad=0.4),
    wheelbase_cm=26.0,
)
META = ModelMeta(WINDOW, (CAMERA.hash,), 26.0, 40.0, "abc", (1.0, 0.5, 0.6, 1.1, 0.5, math.nan), "truth")
META = replace(META, planes=5)
LANE = np.array([-20.0, -20.0, -20.0, 20.0, 20.0, 20.0])


def make_extractor(camera=CAMERA):
    return RoadEdgeExtractor(camera, PerceptionSettings())


@pytest.fixture(scope="module")
def model_path(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "model.onnx"
    network = new_network(NetworkSettings(channels=(4, 8), hidden=8, bins=0), 24, 32, 0).eval()
    network.mean_cm.copy_(torch.from_numpy(LANE))
    # Untrained, it is half sure of each line.
    network.lower_presence(-1.0)
    raster = np.where(np.random.default_rng(0).random((2, 5, 24, 32)) < 0.1, 255, 0).astype(np.uint8)
    export_onnx(network, META, raster, path)
    return path


@pytest.fixture(scope="module")
def width_model_path(tmp_path_factory):
    path = tmp_path_factory.mktemp("width_model") / "model.onnx"
    network = new_network(
        NetworkSettings(channels=(4, 8), hidden=8, bins=0, takes_width=True), 24, 32, 0
    ).eval()
    raster = np.where(np.random.default_rng(0).random((2, 5, 24, 32)) < 0.1, 255, 0).astype(np.uint8)
    export_onnx(network, replace(META, takes_width=True), raster, path)
    return path


def striped_frame():
    """Two white lines on a dark road, at x = -20 and 20 cm."""
    frame = np.full((120, 160, 3), 40, np.uint8)
    v, u = np.mgrid[:120, :160]
    road = CAMERA.intersect_ground(np.stack([u.ravel(), v.ravel()], 1).astype(float)).reshape(120, 160, 2)
    with np.errstate(invalid="ignore"):
        frame[np.abs(np.abs(road[..., 0]) - 20.0) < 2.0] = 230
    return frame


def change_properties(model_path, out, **changes):
    model = onnx.load(model_path)
    properties = {p.key: p.value for p in model.metadata_props} | {HASH_NAME: None} | changes
    del model.metadata_props[:]
    onnx.helper.set_model_props(model, {k: v for k, v in properties.items() if v is not None})
    out.write_bytes(sealed(model.SerializeToString()))
    return out


def test_a_frame_gives_points_errors_and_steering(model_path):
    detector = NetworkDetector(model_path, CAMERA)
    estimate = detector.detect(striped_frame())
    assert estimate.mask.all()
    # Hardly any training is in these weights: the answer is the mean lane, more or less.
    np.testing.assert_allclose(estimate.points_cm, LANE, atol=3.0)
    assert (estimate.sigma_cm > 0.0).all() and ((estimate.presence > 0.0) & (estimate.presence < 1.0)).all()
    centre = (estimate.points_cm[1] + estimate.points_cm[4]) / 2.0
    assert estimate.steering_rad == pytest.approx(math.atan2(-centre, 15.0), abs=1e-5)
    assert 0.0 < estimate.confidence <= 1.0


def test_a_mask_hides_the_car(model_path):
    frame = striped_frame()
    # A bumper with a bright edge, which is no road.
    bumper = frame.copy()
    bumper[105:, 60:100] = 230
    mask = np.zeros((120, 160), np.uint8)
    mask[100:, 55:105] = 255
    masked, plain = NetworkDetector(model_path, CAMERA, mask=mask), NetworkDetector(model_path, CAMERA)
    hidden = masked.detect(bumper).points_cm
    masked.reset()
    # The width that a frame showed stays likely.
    np.testing.assert_allclose(hidden, masked.detect(frame).points_cm, atol=1e-3)
    assert (plain.detect(bumper).points_cm != plain.detect(frame).points_cm).any()
    with pytest.raises(CalibrationError, match=r"mask of 80x60 px.*160x120"):
        NetworkDetector(model_path, CAMERA, mask=mask[::2, ::2])


def test_frames_do_not_leak_into_each_other(model_path):
    detector = NetworkDetector(model_path, CAMERA)
    first = detector.detect(striped_frame())
    empty = detector.detect(np.full((120, 160, 3), 40, np.uint8))
    assert not empty.mask.any() and empty.confidence == 0.0 and math.isnan(empty.steering_rad)
    detector.reset()
    again = detector.detect(striped_frame())
    # The width that a frame showed stays likely.
    np.testing.assert_allclose(first.points_cm, again.points_cm, atol=1e-3)
    # What the caller does with a result does not reach the next one.
    again.sigma_cm[:] = 99.0
    detector.reset()
    np.testing.assert_allclose(detector.detect(striped_frame()).sigma_cm, first.sigma_cm, rtol=1e-2)


def test_a_frame_gives_what_its_raster_gives_on_the_markings(model_path):
    detector = NetworkDetector(model_path, CAMERA)
    frame = striped_frame()
    raster = fill_raster(WINDOW, make_extractor().extract(frame), new_raster(WINDOW))
    alone, refined = detector.detect_raster(raster).points_cm, detector.detect(frame).points_cm
    np.testing.assert_allclose(refined, alone, atol=0.5)
    # The stripes lie 20 cm to either side; at row 0 the camera does not see them.
    ahead = [1, 2, 4, 5]
    assert np.abs(np.abs(refined) - 20.0)[ahead].max() < 0.5 * np.abs(np.abs(alone) - 20.0)[ahead].max()


def test_a_lane_of_another_width_than_was_given_is_said_once(model_path, caplog, monkeypatch):
    monkeypatch.setattr(estimate, "_CERTAIN", 5)
    frame = striped_frame()
    detector = NetworkDetector(model_path, CAMERA, lane_width_cm=32.0)
    warned = list(detector.problems)
    for _ in range(7):
        detector.detect(frame)
    (problem,) = [line for line in detector.problems if line not in warned]
    assert "32 cm" in problem and "40 cm" in problem and caplog.text.count(problem) == 1


def test_without_memory_every_frame_is_the_first_one(model_path):
    frame, other = striped_frame(), np.roll(striped_frame(), 12, axis=1)
    inputs = DetectorInputs(camera=CAMERA, model=model_path)
    single, kept = build_detector("network-single", inputs), build_detector("network", inputs)
    first = kept.detect(frame).points_cm
    for detector in (single, kept):
        for _ in range(12):
            detector.detect(other)
    np.testing.assert_array_equal(single.detect(frame).points_cm, first)
    assert not np.array_equal(kept.detect(frame).points_cm, first)
    with pytest.raises(ConfigError, match="memory"):
        build_detector("network", replace(inputs, config={"memori": False}))


def test_another_camera_is_refused_unless_allowed(model_path):
    other = CAMERA.with_mounting(height_cm=16.0)
    with pytest.raises(ModelMismatchError, match="camera") as caught:
        NetworkDetector(model_path, other)
    assert CAMERA.hash in str(caught.value) and other.hash in str(caught.value)
    assert NetworkDetector(model_path, other, any_camera=True).detect(striped_frame()).mask.all()


def test_a_checkpoint_folder_will_do_for_its_model(model_path):
    detector = NetworkDetector(model_path.parent, CAMERA)
    assert detector.detect(striped_frame()).mask.all()


def test_a_lane_beside_the_widths_of_the_training_is_warned_of_once(model_path):
    ranged = replace(META, lane_width_range_cm=(21.08, 78.26))
    # Told as a card shows them, to the whole centimetre, both ends are inside.
    assert ranged.untrained_widths([21.0, 40.0, 78.5], "m.onnx") == []
    (line,) = ranged.untrained_widths([90.0, 40.0, 15.5, 90.0], "m.onnx")
    assert line.startswith("lane width 15.5 and 90 cm: m.onnx was trained on lanes of 21 to 78 cm")
    # Without a range all lanes had the mean width.
    assert "trained on lanes of 40 cm" in META.untrained_widths([59.0], "m.onnx")[0]
    assert NetworkDetector(model_path, CAMERA).problems == []
    assert NetworkDetector(model_path, CAMERA, lane_width_cm=40.2).problems == []
    (line,) = NetworkDetector(model_path, CAMERA, lane_width_cm=59.0).problems
    assert line.startswith(f"lane width 59 cm: {model_path} was trained")


def test_the_same_camera_at_another_resolution_is_refused(model_path):
    K = CAMERA.K * [[0.5], [0.5], [1.0]]
    half = replace(CAMERA, width=80, height=60, K=K)
    with pytest.raises(
        ModelMismatchError, match=rf"{CAMERA.hash}, but this camera, pinhole 80x60, is {half.hash}"
    ):
        NetworkDetector(model_path, half)


def test_another_window_is_refused(model_path, tmp_path):
    properties = replace(META, window=BirdseyeWindow()).to_properties()
    path = change_properties(model_path, tmp_path / "m.onnx", window=properties["window"])
    with pytest.raises(ModelMismatchError, match="do not fit its window"):
        NetworkDetector(path, CAMERA)


def test_a_frame_of_another_size_is_refused(model_path):
    with pytest.raises(CalibrationError, match="80x60"):
        NetworkDetector(model_path, CAMERA).detect(np.zeros((60, 80, 3), np.uint8))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format": "lanenet-model/9"}, "format 'lanenet-model/9', expected 'lanenet-model/3'"),
        ({"format": None}, "no format"),
        ({"window": None}, "'window' is missing"),
        ({"window": "{"}, "'window' is not JSON"),
        ({"window": '{"rows": 24, "width": 3}'}, "unreadable description"),
        ({"rows_cm": "[0.0, 10.0, 20.0]"}, "rows_cm"),
        ({"signs": '{"steering_rad": "positive right"}'}, "signs"),
        ({"rmse_cm": "[1.0]"}, "rmse_cm has 1 values, expected 6"),
        ({"lane_width_range_cm": "[30.0]"}, "unreadable description"),
        ({"planes": None}, "'planes' is missing"),
        ({"planes": '["edge", "red"]'}, r"planes \['edge', 'red'\], expected"),
        ({"planes": '["edge"]'}, "do not fit its window"),
    ],
)
def test_faulty_descriptions_are_refused(model_path, tmp_path, changes, message):
    path = change_properties(model_path, tmp_path / "m.onnx", **changes)
    with pytest.raises(ModelMismatchError, match=message) as caught:
        read_model_meta(path)
    assert str(path) in str(caught.value)


def test_files_that_are_no_models_are_refused(tmp_path):
    with pytest.raises(ModelMismatchError, match="no such file"):
        read_model_meta(tmp_path / "none.onnx")
    (tmp_path / "text.onnx").write_text("hello")
    with pytest.raises(ModelMismatchError, match=r"text\.onnx: has no hash"):
        read_model_meta(tmp_path / "text.onnx")
    (tmp_path / "text.onnx").write_bytes(sealed(b"hello"))
    with pytest.raises(ModelMismatchError, match=r"text\.onnx: cannot be opened"):
        read_model_meta(tmp_path / "text.onnx")


def test_description_survives_the_trip():
    told = replace(META, lane_width_range_cm=(30.0, 50.0))
    meta = ModelMeta.from_properties(told.to_properties(), "here")
    assert replace(meta, rmse_cm=()) == replace(told, rmse_cm=())
    assert ModelMeta.from_properties(META.to_properties(), "here").widths_cm == META.widths_cm == (40.0, 40.0)
    np.testing.assert_equal(meta.rmse_cm, META.rmse_cm)


def test_a_model_for_any_camera_takes_those_that_see_its_window(model_path, tmp_path):
    path = change_properties(model_path, tmp_path / "any.onnx", camera_hashes='["any"]')
    other = CAMERA.with_mounting(height_cm=17.0)
    assert NetworkDetector(path, other).meta.any_camera
    with pytest.raises(ModelMismatchError, match="sees 0% of the window's far half"):
        NetworkDetector(path, CAMERA.with_mounting(pitch_down_rad=-0.6))
    assert NetworkDetector(path, CAMERA.with_mounting(yaw_rad=3.0), any_camera=True).meta.any_camera


def test_a_model_without_an_output_is_refused(model_path, tmp_path):
    model = onnx.load(model_path)
    for output in [o for o in model.graph.output if o.name in ("sigma_cm", "presence")]:
        model.graph.output.remove(output)
    (tmp_path / "bare.onnx").write_bytes(sealed(model.SerializeToString()))
    with pytest.raises(ModelMismatchError, match="outputs"):
        read_model_meta(tmp_path / "bare.onnx")


class _Session:
    """Answers in turn what a network would."""

    def __init__(self, answers):
        self.answers = list(answers)

    def run(self, names, inputs):
        points, sigma, presence = self.answers.pop(0)
        return [np.array([v], np.float32) for v in (points, sigma, presence)]


def test_a_missing_line_is_rebuilt_from_the_width_of_earlier_frames(model_path, tmp_path, monkeypatch):
    path = change_properties(model_path, tmp_path / "m.onnx", lane_width_range_cm="[25.0, 50.0]")
    raster = np.full((5, 24, 32), 255, np.uint8)
    narrow = 0.75 * LANE
    doubtful = np.concatenate([narrow[:3], LANE[3:]])
    sigma = np.full(6, 0.4)
    wide_sigma = np.concatenate([sigma[:3], np.full(3, 5.0)])
    both, left_only = (narrow, sigma, [0.99, 0.98]), (doubtful, wide_sigma, [0.99, 0.05])

    def estimates(answers, **options):
        detector = NetworkDetector(path, CAMERA, **options)
        monkeypatch.setattr(detector, "_session", _Session(answers))
        return [detector.detect_raster(raster) for _ in answers], detector

    frames, detector = estimates([both] * 12 + [left_only])
    np.testing.assert_allclose(frames[-1].points_cm, narrow, atol=0.3)
    assert frames[-1].sigma_cm[4] < 1.3 and frames[-1].steering_rad == pytest.approx(0.0, abs=0.01)
    # After a gap the lane most likely has the width that it had.
    detector.reset()
    monkeypatch.setattr(detector, "_session", _Session([left_only]))
    np.testing.assert_allclose(detector.detect_raster(raster).points_cm, narrow, atol=0.5)
    forgetful, _ = estimates([left_only])
    np.testing.assert_allclose(forgetful[-1].points_cm, doubtful, atol=1e-4)
    assert forgetful[-1].confidence < frames[-1].confidence
    told, _ = estimates([left_only], lane_width_cm=30.0)
    np.testing.assert_allclose(told[-1].points_cm, narrow, atol=1e-3)


def test_a_frame_of_noise_gives_no_lane(model_path):
    noise = np.random.default_rng(0).integers(0, 256, (CAMERA.height, CAMERA.width, 3)).astype(np.uint8)
    estimate = NetworkDetector(model_path, CAMERA).detect(noise)
    assert not estimate.mask.any() and estimate.confidence == 0.0
    assert estimate.reason == "the frame is all edges"
    dark = NetworkDetector(model_path, CAMERA).detect(np.zeros_like(noise))
    assert dark.reason == "no edge in view" and not dark.mask.any()


def test_a_network_that_answers_no_numbers_gives_no_lane(model_path, monkeypatch):
    detector = NetworkDetector(model_path, CAMERA)
    answer = detector._run()
    broken = answer._replace(sigma_cm=np.full(6, np.nan))
    monkeypatch.setattr(detector, "_run", lambda: broken)
    estimate = detector.detect(striped_frame())
    assert not estimate.mask.any() and estimate.confidence == 0.0 and "no number" in estimate.reason
    monkeypatch.setattr(detector, "_run", lambda: answer)
    assert detector.detect(striped_frame()).mask.any()


@pytest.mark.parametrize("frame", ["noise", "dark"])
def test_the_lane_is_lost_in_frames_that_show_nothing(model_path, monkeypatch, frame):
    lost = []
    monkeypatch.setattr(LaneFilter, "lose", lambda self: lost.append(1))
    detector = NetworkDetector(model_path, CAMERA)
    shape = CAMERA.height, CAMERA.width, 3
    noise = np.random.default_rng(0).integers(0, 256, shape).astype(np.uint8)
    detector.detect(striped_frame())
    assert not lost
    detector.detect(noise if frame == "noise" else np.zeros(shape, np.uint8))
    assert lost


def test_a_network_that_takes_the_width_gets_it(width_model_path, monkeypatch):
    # What the network itself answers.
    monkeypatch.setattr(LaneMemory, "complete", lambda self, points, sigma, presence: (points, sigma))
    raster = fill_raster(WINDOW, make_extractor().extract(striped_frame()), new_raster(WINDOW))
    answers = [
        NetworkDetector(width_model_path, CAMERA, lane_width_cm=width).detect_raster(raster).points_cm
        for width in (None, 25.0, 60.0)
    ]
    session = onnxruntime.InferenceSession(width_model_path, providers=["CPUExecutionProvider"])
    for found, width in zip(answers, (0.0, 25.0, 60.0), strict=True):
        told = {"raster": raster[None], "lane_width_cm": np.array([width], np.float32)}
        np.testing.assert_allclose(found, session.run(["points_cm"], told)[0][0], atol=1e-5)
    assert not np.allclose(answers[0], answers[1]) and not np.allclose(answers[1], answers[2])


def test_no_damaged_byte_of_a_model_goes_unnoticed(model_path, tmp_path):
    data, rng = model_path.read_bytes(), np.random.default_rng(0)
    for at in [*rng.integers(0, len(data), 200).tolist(), 0, len(data) - 1, len(data) - 40]:
        damaged = bytearray(data)
        damaged[at] ^= 1 << int(rng.integers(8))
        (tmp_path / "m.onnx").write_bytes(damaged)
        with pytest.raises(ModelMismatchError, match=r"m\.onnx"):
            read_model_meta(tmp_path / "m.onnx")
    (tmp_path / "m.onnx").write_bytes(data[:-1])
    with pytest.raises(ModelMismatchError, match=r"m\.onnx"):
        read_model_meta(tmp_path / "m.onnx")


def test_a_model_that_answers_otherwise_than_where_it_was_made_is_refused(model_path, tmp_path):
    model = onnx.load(model_path)
    bias = next(w for w in model.graph.initializer if w.data_type == onnx.TensorProto.FLOAT)
    values = onnx.numpy_helper.to_array(bias) + np.float32(0.5)
    bias.CopyFrom(onnx.numpy_helper.from_array(values, bias.name))
    del model.metadata_props[-1]
    (tmp_path / "m.onnx").write_bytes(sealed(model.SerializeToString()))
    with pytest.raises(ModelMismatchError, match=r"m\.onnx: self-test: points_cm"):
        read_model_meta(tmp_path / "m.onnx")


@pytest.mark.parametrize(
    "test",
    [
        None,
        "{",
        "[" * 100_000,
        '{"raster": "AAAA", "answers": {}, "tolerance": 1}',
        '{"raster": "?", "answers": {}, "tolerance": 1}',
        '{"raster": "", "answers": {"points_cm": [NaN]}, "tolerance": 1}',
    ],
)
def test_a_model_without_a_usable_self_test_is_refused(model_path, tmp_path, test):
    path = change_properties(model_path, tmp_path / "m.onnx", self_test=test)
    with pytest.raises(ModelMismatchError, match=r"m\.onnx.*self_test"):
        read_model_meta(path)


def test_the_self_test_shows_all_planes(model_path, tmp_path):
    properties = {p.key: p.value for p in onnx.load(model_path).metadata_props}
    test = json.loads(properties["self_test"])
    packed = zlib.decompress(base64.b64decode(test["raster"]))
    assert len(packed) == 5 * 24 * 32
    first = base64.b64encode(zlib.compress(packed[: 24 * 32])).decode()
    path = change_properties(model_path, tmp_path / "m.onnx", self_test=json.dumps(test | {"raster": first}))
    with pytest.raises(ModelMismatchError, match=r"m\.onnx.*self_test"):
        read_model_meta(path)


def test_a_self_test_that_every_answer_passes_is_refused(model_path, tmp_path):
    test = '{"raster": "", "answers": {}, "tolerance": 50}'
    path = change_properties(model_path, tmp_path / "m.onnx", self_test=test)
    with pytest.raises(ModelMismatchError, match="tolerance"):
        read_model_meta(path)


@pytest.mark.parametrize(
    "changes",
    [
        {"window": '{"left_cm": 0, "near_cm": 0, "cell_cm": 1, "rows": 1000000000, "columns": 1000000000}'},
        {"window": '{"left_cm": 0, "near_cm": 0, "cell_cm": 0, "rows": 24, "columns": 32}'},
        {"window": "[" * 100_000},
        {"wheelbase_cm": "true"},
        {"lane_width_cm": "1e308"},
        {"perception": "[]"},
        {"rmse_cm": '"abcdef"'},
        {"camera_hashes": "3"},
    ],
)
def test_impossible_descriptions_are_refused(model_path, tmp_path, changes):
    path = change_properties(model_path, tmp_path / "m.onnx", **changes)
    with pytest.raises(ModelMismatchError, match=rf"m\.onnx.*{next(iter(changes))}"):
        read_model_meta(path)


@pytest.mark.parametrize("name", ["small", "general"])
def test_the_shipped_models_pass_their_self_test(name):
    assert read_model_meta(Path(__file__).parents[3] / "checkpoints" / name).window.rows == 96
