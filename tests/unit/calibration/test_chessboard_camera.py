from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest
from chessboards import fisheye_of, views_of

from lanenet.calibration.bundle import LensFit
from lanenet.calibration.chessboard import BoardView
from lanenet.calibration.chessboard_camera import (
    calibrate_lens,
    check_wanted_model,
    folds_inside,
    miss_text,
    view_errors_px,
)
from lanenet.calibration.ground import calibrate_ground
from lanenet.calibration.lens import camera_of_lens
from lanenet.errors import CalibrationError
from lanenet.geometry.camera import Camera, CameraModel, Mounting

NEAR_METRE_CM = np.stack(
    np.meshgrid(np.arange(-40.0, 41.0, 10.0), np.arange(10.0, 101.0, 10.0)), axis=-1
).reshape(-1, 2)


def check_lens(field_deg: float, seed: int) -> None:
    """The limits that a fisheye of 160 to 200 degrees has to keep, at 12 views with 0.2 px of noise."""
    rng = np.random.default_rng(seed)
    truth = fisheye_of(field_deg, rng)
    found = calibrate_lens(views_of(truth, rng), "fisheye").camera
    assert found.K[0, 0] == pytest.approx(truth.K[0, 0], rel=0.003)
    assert found.K[1, 1] == pytest.approx(truth.K[1, 1], rel=0.003)
    pixels = truth.project_ground(NEAR_METRE_CM)
    with np.errstate(invalid="ignore"):
        seen = ((pixels > 0.0) & (pixels < [truth.width - 1, truth.height - 1])).all(axis=1)
    mounted = calibrate_ground(found, NEAR_METRE_CM[seen], pixels[seen])
    error_cm = np.linalg.norm(mounted.camera.intersect_ground(pixels[seen]) - NEAR_METRE_CM[seen], axis=1)
    assert error_cm.max() < 0.2


@pytest.mark.parametrize(
    "field_deg", [*(pytest.param(field_deg, marks=pytest.mark.slow) for field_deg in (160.0, 180.0)), 200.0]
)
def test_a_wide_fisheye_is_found(field_deg: float) -> None:
    check_lens(field_deg, seed=int(field_deg))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(20))
def test_twenty_lenses_without_one_failure(seed: int) -> None:
    check_lens((160.0, 180.0, 200.0)[seed % 3], seed)


@pytest.fixture(scope="module")
def truth() -> Camera:
    return fisheye_of(170.0, np.random.default_rng(3))


@pytest.fixture(scope="module")
def views(truth: Camera) -> list[BoardView]:
    return views_of(truth, np.random.default_rng(4), 10)


def test_bad_views_are_dropped_and_named(truth: Camera, views: list[BoardView]) -> None:
    rng = np.random.default_rng(0)
    spoilt = dataclasses.replace(
        views[2], name="spoilt", corners_px=views[2].corners_px + rng.normal(0.0, 8.0, (54, 2))
    )
    small = dataclasses.replace(views[3], name="small", width=320, height=240)
    again = dataclasses.replace(views[4], name="again")
    result = calibrate_lens([*views, spoilt, small, again], "fisheye")
    assert set(result.dropped) == {"spoilt", "small", "again"}
    assert "320x240" in result.dropped["small"]
    assert "view4" in result.dropped["again"]
    assert set(view_errors_px(result)) == {view.name for view in views}
    assert result.fit.rms_px == pytest.approx(0.2 * np.sqrt(2.0), rel=0.15)
    assert result.camera.K[0, 0] == pytest.approx(truth.K[0, 0], rel=0.005)
    assert abs(result.camera.K[0, 0] - truth.K[0, 0]) < 4.0 * result.residuals["fx_sigma_px"]


def test_the_model_is_chosen_by_evidence(views: list[BoardView]) -> None:
    assert calibrate_lens(views).camera.model == "fisheye"
    K = np.array([[500.0, 0.0, 322.0], [0.0, 505.0, 238.0], [0.0, 0.0, 1.0]])
    straight = Camera(
        "pinhole", 640, 480, K, np.array([-0.3, 0.12, 0.004, -0.003, 0.0]), Mounting(20.0), 26.0
    )
    rng = np.random.default_rng(1)
    result = calibrate_lens(views_of(straight, rng, 8, near_cm=25.0, far_cm=60.0))
    assert result.camera.model == "pinhole"
    np.testing.assert_allclose(result.camera.K, K, rtol=0.01, atol=3.0)


def test_too_few_or_equal_views_are_refused(truth: Camera, views: list[BoardView]) -> None:
    with pytest.raises(CalibrationError, match="3 usable view"):
        calibrate_lens(views[:3])
    rng = np.random.default_rng(0)
    copies = [
        dataclasses.replace(
            views[0], name=f"copy{k}", corners_px=views[0].corners_px + rng.normal(0, 0.2, (54, 2))
        )
        for k in range(12)
    ]
    with pytest.raises(CalibrationError, match="1 usable view"):
        calibrate_lens(copies)
    with pytest.raises(CalibrationError, match="0 usable view"):
        calibrate_lens([])


def test_boards_that_all_face_the_camera_are_refused() -> None:
    K = np.array([[900.0, 0.0, 319.5], [0.0, 900.0, 239.5], [0.0, 0.0, 1.0]])
    lens = Camera("pinhole", 640, 480, K, np.zeros(5), Mounting(20.0), 26.0)
    rng = np.random.default_rng(2)
    flat = np.column_stack([views_of(lens, rng, 1, near_cm=60.0, far_cm=80.0)[0].points_cm, np.zeros(54)])
    views = [
        BoardView(
            f"{k}",
            640,
            480,
            flat[:, :2],
            lens.project_rays(flat + [x, y, 70.0]) + rng.normal(0.0, 0.1, (54, 2)),
        )
        for k, (x, y) in enumerate(rng.uniform([-22.0, -16.0], [4.0, 4.0], (8, 2)))
    ]
    with pytest.raises(CalibrationError, match="too alike"):
        calibrate_lens(views, "pinhole")


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_random_corners_give_an_error_and_no_camera(seed: int, views: list[BoardView]) -> None:
    rng = np.random.default_rng(seed)
    noise = [dataclasses.replace(v, corners_px=rng.uniform(0.0, 470.0, (54, 2))) for v in views[:6]]
    with pytest.raises(CalibrationError):
        calibrate_lens(noise)


@pytest.mark.parametrize(("field_deg", "seed"), [(170.0, 4), pytest.param(200.0, 1, marks=pytest.mark.slow)])
def test_a_pinhole_forced_on_a_fisheye_is_refused(field_deg: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    views = views_of(fisheye_of(field_deg, rng), rng, 10)
    with pytest.raises(
        CalibrationError, match=r"pinhole lens .* fisheye lens .*0\.[23]\d px.*--model fisheye"
    ):
        calibrate_lens(views, "pinhole")


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_forced_models_over_seeds(seed: int) -> None:
    rng = np.random.default_rng(seed)
    wide = views_of(fisheye_of((140.0, 170.0, 200.0)[seed % 3], rng), rng, 12)
    with pytest.raises(CalibrationError, match="--model fisheye"):
        calibrate_lens(wide, "pinhole")
    assert calibrate_lens(wide, "fisheye").camera.model == "fisheye"
    # A narrow lens without distortion is both, and neither choice is an error.
    K = np.array([[700.0, 0.0, 322.0], [0.0, 703.0, 238.0], [0.0, 0.0, 1.0]])
    narrow = Camera("pinhole", 640, 480, K, np.zeros(5), Mounting(20.0), 26.0)
    views = views_of(narrow, rng, 12, near_cm=35.0, far_cm=80.0)
    for model in ("pinhole", "fisheye"):
        found = calibrate_lens(views, model).camera
        assert found.model == model
        assert found.K[0, 0] == pytest.approx(700.0, rel=0.02)


def test_wanted_models_are_compared() -> None:
    fits: dict[CameraModel, LensFit] = {"fisheye": fit_with_rms(0.30), "pinhole": fit_with_rms(0.31)}
    assert check_wanted_model("pinhole", "fisheye", fits, None) is None
    fits["pinhole"] = fit_with_rms(0.37)
    note = check_wanted_model("pinhole", "fisheye", fits, None)
    assert note is not None and "0.37 px as pinhole, 0.30 px as fisheye" in note
    fits["pinhole"] = fit_with_rms(0.52)
    with pytest.raises(
        CalibrationError, match=r"pinhole lens misses .* 0\.52 px RMS, .* 0\.30 px: use --model"
    ):
        check_wanted_model("pinhole", "fisheye", fits, None)
    # Both are good enough: a twentieth of a pixel is no error, but a note.
    tiny: dict[CameraModel, LensFit] = {"fisheye": fit_with_rms(0.03), "pinhole": fit_with_rms(0.07)}
    assert check_wanted_model("pinhole", "fisheye", tiny, None) is not None
    with pytest.raises(CalibrationError, match=r"does not fit these views \(folds"):
        check_wanted_model("pinhole", "fisheye", {"fisheye": fit_with_rms(0.3)}, "folds the image back")


def fit_with_rms(rms_px: float) -> LensFit:
    residuals = [np.full((54, 2), rms_px / np.sqrt(2.0))]
    lens = np.zeros(9)
    return LensFit("pinhole", lens, lens == 0.0, np.zeros((1, 6)), residuals, lens, 1.0)


def test_a_pinhole_that_folds_inside_the_image_is_not_taken() -> None:
    # r (1 - 0.3 r^2) grows up to r = 1.05, where it is 0.70; the image reaches 1.33.
    camera = camera_of_lens("pinhole", np.array([300.0, 300.0, 319.5, 239.5, -0.3, 0, 0, 0, 0]), (640, 480))
    assert folds_inside(camera)
    # r (1 - 0.1 r^2) grows up to r = 1.83, where it is 1.22; the image reaches 1.00.
    milder = camera_of_lens("pinhole", np.array([400.0, 400.0, 319.5, 239.5, -0.1, 0, 0, 0, 0]), (640, 480))
    assert not folds_inside(milder)


def test_corners_of_a_turned_board_are_named(views: list[BoardView]) -> None:
    def turned(view: BoardView) -> BoardView:
        grid = view.corners_px.reshape(6, 9, 2).transpose(1, 0, 2)
        return dataclasses.replace(view, corners_px=grid.reshape(-1, 2).copy())

    with pytest.raises(CalibrationError, match=r"do not fit one board.* 6x9 board, expected 9x6"):
        calibrate_lens([turned(view) for view in views])
    result = calibrate_lens([*views[:7], *[turned(view) for view in views[7:]]], "fisheye")
    assert set(result.dropped) == {view.name for view in views[7:]}
    assert "6x9" in result.dropped[views[8].name]


def test_corners_of_no_board_give_a_message_that_can_be_read(views: list[BoardView]) -> None:
    rng = np.random.default_rng(0)
    shuffled = [dataclasses.replace(v, corners_px=rng.permutation(v.corners_px)) for v in views[:6]]
    with pytest.raises(CalibrationError, match="do not fit one board") as caught:
        calibrate_lens(shuffled)
    assert max(float(number) for number in re.findall(r"\d+\.?\d*", str(caught.value))) < 1e5
    assert miss_text(1.3e18, views) == "misses the corners altogether"
    assert miss_text(12.34, views) == "misses the corners by 12.3 px"


def test_a_large_residual_is_noted(truth: Camera) -> None:
    noisy = views_of(truth, np.random.default_rng(8), 6, noise_px=0.5)
    assert any(note.startswith("RMS 0.") for note in calibrate_lens(noisy, "fisheye").notes)
