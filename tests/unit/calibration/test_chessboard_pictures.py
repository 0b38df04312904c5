from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from chessboards import BOARD, board_poses, fisheye_of, painted
from typer.testing import CliRunner

from lanenet.calibration.chessboard import BoardView, find_view, find_views, list_pictures, parse_board
from lanenet.calibration.chessboard_camera import calibrate_lens
from lanenet.calibration.lens import pose_from_mounting
from lanenet.calibration.pictures import plane_picture
from lanenet.cli.app import app
from lanenet.data.camera_file import read_camera, write_camera
from lanenet.errors import CalibrationError, ConfigError


def test_corners_of_a_painted_board_are_found() -> None:
    rng = np.random.default_rng(0)
    camera = fisheye_of(170.0, rng)
    rotation, centre = board_poses(camera, rng, 1)[0]
    view = find_view("painted", painted(camera, rotation, centre, rng), BOARD)
    assert isinstance(view, BoardView) and view.complete
    flat = BOARD.points_cm() - BOARD.points_cm().mean(axis=0)
    # A finder may number the corners from any end of the board.
    orders = [flat * [sx, sy] for sx in (1.0, -1.0) for sy in (1.0, -1.0)]
    errors = [
        np.linalg.norm(
            camera.project_rays(np.column_stack([o, np.zeros(54)]) @ rotation.T + centre) - view.corners_px,
            axis=1,
        ).max()
        for o in orders
    ]
    assert min(errors) < 0.5


@pytest.mark.parametrize(
    "picture",
    [
        np.zeros((240, 320), np.uint8),
        np.full((240, 320, 3), 255, np.uint8),
        np.zeros((1, 1, 3), np.uint8),
        np.zeros((0, 0, 3), np.uint8),
        np.zeros((240, 320), np.float32),
        np.zeros((240, 320, 4), np.uint8),
        np.random.default_rng(0).integers(0, 256, (240, 320, 3)).astype(np.uint8),
    ],
    ids=["black", "white", "1 x 1", "empty", "float", "alpha", "noise"],
)
def test_a_picture_without_board_gives_a_reason(picture: np.ndarray) -> None:
    assert isinstance(find_view("p", picture, BOARD), str)


def test_words_become_pictures(tmp_path: Path) -> None:
    for name in ("a10.png", "a2.png", "note.txt"):
        (tmp_path / name).write_bytes(b"x")
    named = [path.name for path in list_pictures([str(tmp_path), str(tmp_path / "a*.png")])]
    assert named == ["a2.png", "a10.png"]
    with pytest.raises(CalibrationError, match="no such image"):
        list_pictures([str(tmp_path / "missing.png")])
    with pytest.raises(CalibrationError, match="whole board with 9x6"):
        find_views([tmp_path / "a2.png"], BOARD)
    assert parse_board("9x6").columns == 9
    for text in ("9", "2x2", "9x6x3", "-9x6"):
        with pytest.raises(ConfigError, match="--board"):
            parse_board(text)


def test_the_picture_from_above_has_the_road_where_the_grid_says() -> None:
    camera = fisheye_of(170.0, np.random.default_rng(1))
    frame = np.zeros((camera.height, camera.width, 3), np.uint8)
    u, v = camera.project_ground(np.array([[12.0, 33.0]]))[0]
    cv2.circle(frame, (round(u), round(v)), 3, (255, 255, 255), -1)
    # 4 px per cm leave a grid of 10 cm, which touches neither the spot nor its surroundings.
    picture = plane_picture(frame, camera, pose_from_mounting(camera.mounting), (-25.0, 5.0, 25.0, 55.0), 4.0)
    assert picture.shape == (200, 200, 3)
    rows, columns = np.nonzero(picture[70:106, 132:178].min(axis=2) > 200)
    spot = np.array([columns.mean() + 132, rows.mean() + 70])
    np.testing.assert_allclose(spot, [(12.0 + 25.0) * 4.0, (55.0 - 33.0) * 4.0], atol=4.0)


@pytest.mark.parametrize(
    ("folder", "views", "rms_px"),
    [("picam_9x6", 20, 0.15), pytest.param("udacity_9x6", 17, 1.0, marks=pytest.mark.slow)],
)
def test_real_chessboards(shared_data: Path, folder: str, views: int, rms_px: float) -> None:
    found, left_out = find_views(list_pictures([str(shared_data / "chessboards" / folder)]), BOARD)
    result = calibrate_lens(found, "pinhole")
    assert not left_out and len(result.views) >= views
    assert result.fit.rms_px <= rms_px
    if folder == "picam_9x6":
        np.testing.assert_allclose(np.diag(result.camera.K)[:2], [322.6, 323.2], rtol=0.01)
    else:
        assert sum("1281x721" in reason for reason in result.dropped.values()) == 2


def test_ground_command_replaces_the_mounting(tmp_path: Path) -> None:
    truth = fisheye_of(170.0, np.random.default_rng(2))
    points = np.array([[-20.0, 15.0], [20.0, 15.0], [-25.0, 50.0], [25.0, 55.0], [0.0, 30.0], [5.0, 70.0]])
    rows = np.column_stack([points, truth.project_ground(points)])
    (tmp_path / "points.csv").write_text(
        "x_cm,y_cm,u_px,v_px\n" + "\n".join(",".join(f"{value:.6f}" for value in row) for row in rows) + "\n"
    )
    write_camera(tmp_path / "lens.yaml", truth.with_mounting(height_cm=99.0, roll_rad=0.0), "a lens")
    cv2.imwrite(str(tmp_path / "photo.png"), np.full((480, 640, 3), 90, np.uint8))
    words = ["calibrate", "ground", str(tmp_path / "points.csv"), "--camera", str(tmp_path / "lens.yaml")]
    out = tmp_path / "camera.yaml"
    result = CliRunner().invoke(app, [*words, "--out", str(out), "--image", str(tmp_path / "photo.png")])
    assert result.exit_code == 0, result.output
    found = read_camera(out).mounting
    assert found.height_cm == pytest.approx(truth.mounting.height_cm, abs=1e-3)
    assert found.roll_rad == pytest.approx(truth.mounting.roll_rad, abs=1e-5)
    assert (tmp_path / "camera-birdseye.png").is_file() and (tmp_path / "camera-undistorted.png").is_file()
    assert "6 of 6 points used" in result.stdout and "next: lanenet" in result.stdout


def test_commands_say_what_is_wrong(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "black.png"), np.zeros((240, 320, 3), np.uint8))
    words = ["calibrate", "chessboard", str(tmp_path), "--board", "9x6", "--out", str(tmp_path / "c.yaml")]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 1
    assert "error: none of 1 images shows a whole board" in result.stderr
    assert not (tmp_path / "c.yaml").exists()
