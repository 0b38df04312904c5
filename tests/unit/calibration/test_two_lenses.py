from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from chessboards import BOARD, fisheye_of, views_of

from lanenet.calibration.bundle import LensFit, free_numbers, poses_of_views, refine
from lanenet.calibration.chessboard import BoardView, find_views, list_pictures
from lanenet.calibration.chessboard_camera import calibrate_lens
from lanenet.calibration.lens import N_DISTORTION
from lanenet.calibration.views import FocalScales, best_split, focal_scales
from lanenet.errors import CalibrationError
from lanenet.geometry.camera import Camera, CameraModel, Mounting


def lens_of(model: CameraModel, rng: np.random.Generator) -> Camera:
    if model == "fisheye":
        return fisheye_of(float(rng.choice([140.0, 160.0, 180.0, 200.0])), rng)
    focal = rng.uniform(450.0, 800.0)
    K = np.array([[focal, 0.0, 322.0], [0.0, 1.01 * focal, 236.0], [0.0, 0.0, 1.0]])
    D = np.array([rng.uniform(-0.25, 0.05), rng.uniform(0.0, 0.1), 0.001, -0.002, 0.0])
    return Camera("pinhole", 640, 480, K, D, Mounting(20.0), 26.0)


def views_before(camera: Camera, rng: np.random.Generator, count: int, name: str) -> list[BoardView]:
    far = (
        {}
        if camera.model == "fisheye"
        else {"near_cm": 0.05 * camera.K[0, 0], "far_cm": 0.15 * camera.K[0, 0]}
    )
    views = views_of(camera, rng, count, **far)
    return [dataclasses.replace(view, name=f"{name}{k}") for k, view in enumerate(views)]


def mixed(
    model: CameraModel, seed: int, counts: tuple[int, int], ratio: float
) -> tuple[Camera, list[BoardView]]:
    """Views of a lens, and of one with another focal length."""
    rng = np.random.default_rng(seed)
    one = lens_of(model, rng)
    other = dataclasses.replace(one, K=one.K * [[ratio, 1.0, 1.0], [1.0, ratio, 1.0], [1.0, 1.0, 1.0]])
    return one, [*views_before(one, rng, counts[0], "a"), *views_before(other, rng, counts[1], "b")]


def fit_of_one_lens(camera: Camera, views: list[BoardView]) -> LensFit:
    lens = np.array([camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2], *camera.D])
    poses = poses_of_views(camera.model, lens, views)
    assert poses is not None
    free = free_numbers(camera.model, range(N_DISTORTION[camera.model]))
    return refine(camera.model, lens, poses, views, free)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("model", ["fisheye", "pinhole"])
@pytest.mark.parametrize(("counts", "ratio"), [((8, 8), 1.08), ((10, 3), 0.92), ((9, 4), 1.15)])
def test_two_focal_lengths_are_told_apart(
    model: CameraModel, seed: int, counts: tuple[int, int], ratio: float
) -> None:
    camera, views = mixed(model, seed, counts, ratio)
    scales = focal_scales(fit_of_one_lens(camera, views), views)
    assert scales is not None
    split = best_split(scales)
    assert split is not None and split.is_clear
    factor = max(ratio, 1.0 / ratio)
    assert split.difference == pytest.approx(factor - 1.0, abs=0.03)
    # Boards seen from straight ahead may be in neither group, and one that can hardly tell in the wrong one.
    longer = "b" if ratio > 1.0 else "a"
    wrong = sum(views[k].name[0] != longer for k in split.longer)
    wrong += sum(views[k].name[0] == longer for k in split.shorter)
    assert wrong <= (0 if model == "fisheye" else 1)
    assert len(split.longer) + len(split.shorter) >= 0.4 * len(views)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("model", ["fisheye", "pinhole"])
def test_one_lens_is_not_taken_for_two(model: CameraModel, seed: int) -> None:
    camera, views = mixed(model, 100 + seed, (7 + 2 * seed, 0), 1.0)
    scales = focal_scales(fit_of_one_lens(camera, views), views)
    assert scales is not None
    split = best_split(scales)
    assert split is None or not split.is_clear
    # What is stated as uncertainty is the spread of the views' focal lengths.
    chi = scales.log_scale / np.sqrt(np.diag(scales.covariance))
    assert np.abs(chi).max() < 4.5


def test_a_split_by_hand() -> None:
    # Two groups at 0 and 0.1, each known to 0.01; with the breathing of a lens, 0.01, the difference of two
    # means of four is known to sqrt(0.0002 / 4 * 2) = 0.01, and ten times its sigma is an evidence of 100.
    values = np.repeat([0.0, 0.1], 4)
    split = best_split(FocalScales(values, 1e-4 * np.eye(8), np.full(8, 0.3)))
    assert split is not None and split.is_clear
    assert (split.shorter, split.longer) == ([0, 1, 2, 3], [4, 5, 6, 7])
    assert split.difference == pytest.approx(np.exp(0.1) - 1.0)
    assert split.evidence == pytest.approx(100.0)
    # A view that misses its corners even so is no witness, nor is one that knows nothing.
    rms = np.array([0.3, 0.3, 0.3, 0.3, 0.3, 0.3, 0.3, 5.0])
    split = best_split(FocalScales(values, 1e-4 * np.eye(8), rms))
    assert split is not None and split.unsure == [7]
    vague = np.diag([1e-2, *[1e-4] * 7])
    split = best_split(FocalScales(values, vague, np.full(8, 0.3)))
    assert split is not None and split.unsure == [0]
    # Evenly spread focal lengths are not two groups, however well they are known.
    split = best_split(FocalScales(np.linspace(-0.05, 0.05, 8), 1e-8 * np.eye(8), np.full(8, 0.3)))
    assert split is not None and not split.is_clear
    assert best_split(FocalScales(values[:4], 1e-4 * np.eye(4), np.full(4, 0.3))) is None


def test_mixed_views_are_refused_and_named() -> None:
    _, views = mixed("fisheye", 3, (6, 6), 1.08)
    with pytest.raises(CalibrationError, match=r"of two lenses.*b0, b1.* than in a0, a1") as caught:
        calibrate_lens(views)
    assert "8." in str(caught.value) or "7." in str(caught.value)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(10, 16))
@pytest.mark.parametrize("model", ["fisheye", "pinhole"])
def test_over_seeds_mixed_views_are_refused_and_others_are_not(model: CameraModel, seed: int) -> None:
    camera, views = mixed(model, seed, (8, 6), 1.08)
    with pytest.raises(CalibrationError, match="of two lenses"):
        calibrate_lens(views)
    found = calibrate_lens(mixed(model, seed, (12, 0), 1.0)[1]).camera
    assert found.K[0, 0] == pytest.approx(camera.K[0, 0], rel=0.02)


@pytest.mark.slow
def test_real_views_of_one_camera_are_not_taken_for_two(shared_data: Path) -> None:
    found, _ = find_views(list_pictures([str(shared_data / "chessboards" / "picam_9x6")]), BOARD)
    whole = calibrate_lens(found, "pinhole")
    c = whole.camera.K[:2, 2]
    refused = 0
    for seed in range(8):
        rng = np.random.default_rng(seed)
        some = [whole.views[k] for k in rng.permutation(len(whole.views))[: rng.integers(9, 20)]]
        poses = poses_of_views("pinhole", whole.fit.lens, some)
        assert poses is not None
        fit = refine("pinhole", whole.fit.lens, poses, some, whole.fit.free)
        scales = focal_scales(fit, some)
        split = None if scales is None else best_split(scales)
        assert split is None or not split.is_clear
        # The same camera with its picture enlarged by 8 % in half of the views.
        chosen = set(rng.permutation(20)[:10].tolist())
        views = [
            dataclasses.replace(view, corners_px=(view.corners_px - c) * 1.08 + c) if k in chosen else view
            for k, view in enumerate(whole.views)
        ]
        fit = refine("pinhole", whole.fit.lens, whole.fit.poses, views, whole.fit.free)
        scales = focal_scales(fit, views)
        split = None if scales is None else best_split(scales)
        refused += split is not None and split.is_clear
    assert refused >= 6
