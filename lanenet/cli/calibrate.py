"""``lanenet calibrate``: the camera, from a chessboard, from points on the ground, or from a drive."""

from __future__ import annotations

import datetime
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer

from lanenet.calibration.printed import Paper
from lanenet.cli.shared import console
from lanenet.cli.shared.options import (
    DriveArgument,
    MappingOption,
    WheelbaseOption,
    check_beside,
    check_ending,
    check_not_source,
    lane_cm,
    length_cm,
    lock_outputs,
)
from lanenet.config import read_yaml
from lanenet.errors import CalibrationError, ConfigError

if TYPE_CHECKING:
    from datagen.calibrate_drive import CalibratedDrive
    from lanenet.calibration.chessboard_camera import ChessboardCalibration
    from lanenet.calibration.ground import GroundCalibration
    from lanenet.geometry.camera import Camera

app = typer.Typer(
    name="calibrate",
    no_args_is_help=True,
    help="Find the camera: its lens, and where it sits on the car.",
)

_Board = Annotated[str | None, typer.Option(help="Inner corners of the board, for example 9x6.")]
_Square = Annotated[float, typer.Option(parser=length_cm, metavar="CM", help="Side of a square, cm.")]
#: Left, near, right and far edge of the bird's-eye pictures, [cm]; chosen: two lanes wide, three car lengths.
_AREA_CM = (-60.0, 0.0, 60.0, 120.0)
#: Scale of bird's-eye pictures that stand side by side.
_SMALL_PX_PER_CM = 4.0
#: The pictures beside the camera file, of a lens and of a mounting.
_LENS_PICTURES, _ROAD_PICTURES = ("undistorted", "board"), ("undistorted", "birdseye")
_Out = Annotated[Path, typer.Option(help="Camera file to write (.yaml).")]


class LensModel(StrEnum):
    """Lens models of ``lanenet calibrate chessboard``."""

    AUTO = "auto"
    FISHEYE = "fisheye"
    PINHOLE = "pinhole"


@app.command(epilog="Example: lanenet calibrate chessboard photos/*.jpg --board 9x6 --out runs/camera.yaml")
def chessboard(
    images: Annotated[list[str], typer.Argument(metavar="IMAGES", help="Photos, patterns or folders.")],
    board: Annotated[str, typer.Option(help="Inner corners of the board, as 9x6.")],
    out: _Out,
    square: _Square = 2.5,
    model: Annotated[
        LensModel, typer.Option(help="Lens model; auto takes the one that fits better.")
    ] = LensModel.AUTO,
    height: Annotated[
        float | None,
        typer.Option(
            parser=length_cm, metavar="CM", help="Height of the lens above the ground, cm; default 20."
        ),
    ] = None,
    pitch: Annotated[
        float | None, typer.Option(help="Downward tilt of the camera, degrees; default 0.")
    ] = None,
    wheelbase: WheelbaseOption = None,
    ros: Annotated[Path | None, typer.Option(help="Also write a ROS camera_info file (.yaml).")] = None,
) -> None:
    """Find a camera's lens from photos of a chessboard held in different tilts and places."""
    from lanenet.calibration.chessboard import common_turn, find_views, list_pictures, parse_board
    from lanenet.calibration.chessboard_camera import calibrate_lens
    from lanenet.calibration.lens import NOMINAL_HEIGHT_CM
    from lanenet.data.camera_file import write_camera, write_ros_camera_info
    from lanenet.geometry.camera import NOMINAL_WHEELBASE_CM, Mounting

    for path in (out, ros):
        if path is not None:
            check_ending(path, ".yaml", ".yml")
    check_beside(out, *_pictures(out, *_LENS_PICTURES))
    lock_outputs(out, ros)
    wanted = parse_board(board, square)
    paths = list_pictures(images)
    with console.progress_bar("calibrate") as progress:
        views, left_out = find_views(
            paths, wanted, lambda done, total: progress("find the board", done, total)
        )
        mounting = Mounting(
            NOMINAL_HEIGHT_CM if height is None else height,
            float(np.deg2rad(0.0 if pitch is None else pitch)),
        )
        result = calibrate_lens(
            views,
            model.value,
            mounting,
            NOMINAL_WHEELBASE_CM if wheelbase is None else wheelbase,
            lambda done, total: progress("fit the lens", done, total),
        )
    # A board in the hand says nothing about the mounting: only `calibrate ground` measures it.
    given = [name for name, value in (("height", height), ("pitch", pitch)) if value is not None]
    origin = "given " + " and ".join(given) if given else "nominal values"
    notes = [*result.notes, f"the mounting is not measured ({origin}); run `lanenet calibrate ground`"]
    if wheelbase is None:
        notes.append(f"the wheelbase is a nominal {NOMINAL_WHEELBASE_CM:g} cm; give --wheelbase")
    write_camera(
        out,
        result.camera,
        f"chessboard {board}, {len(result.views)} views; mounting not measured ({origin})",
        result.residuals,
        datetime.date.today().isoformat(),
    )
    if ros is not None:
        write_ros_camera_info(ros, result.camera, out.stem)
    pictures = _lens_pictures(out, result, common_turn(paths))
    left_out = {**left_out, **result.dropped}
    _show_lens(result, len(paths))
    console.show_problems([f"left out {name}: {reason}" for name, reason in left_out.items()], limit=100)
    console.show_problems(notes)
    console.wrote(out, ros, *pictures)
    console.next_command("calibrate", "ground", "POINTS.csv", "--camera", out, "--out", out)


@app.command(
    epilog="Example: lanenet calibrate ground points.csv --camera runs/camera.yaml --out runs/camera.yaml"
)
def ground(
    camera: Annotated[Path, typer.Option("--camera", help="Camera YAML, or one of ROS, OpenCV or Kalibr.")],
    out: _Out,
    points: Annotated[
        Path | None,
        typer.Argument(metavar="POINTS.csv", help="Columns x_cm, y_cm (right, ahead), u_px, v_px."),
    ] = None,
    image: Annotated[
        Path | None, typer.Option(help="Photo of the ground, with the board if there is one.")
    ] = None,
    board: _Board = None,
    square: _Square = 2.5,
    near_left: Annotated[
        str | None,
        typer.Option(help="The board's inner corner nearest to the car and leftmost, as X,Y in cm."),
    ] = None,
    wheelbase: WheelbaseOption = None,
) -> None:
    """Find where the camera sits, from points on the ground or from a board that lies there (--board)."""
    from dataclasses import replace

    from lanenet.calibration.chessboard import read_picture
    from lanenet.calibration.ground import calibrate_ground
    from lanenet.calibration.pictures import points_picture
    from lanenet.data.camera_file import write_camera

    check_ending(out, ".yaml", ".yml")
    check_beside(out, *([] if image is None else _pictures(out, *_ROAD_PICTURES)))
    lock_outputs(out)
    lens = _read_lens(camera)
    if wheelbase is not None:
        lens = replace(lens, wheelbase_cm=wheelbase)
    frame = None if image is None else read_picture(image)
    if frame is not None and frame.shape[:2] != (lens.height, lens.width):
        raise CalibrationError(
            f"{image}: {frame.shape[1]}x{frame.shape[0]} px, but the camera has {lens.width}x{lens.height}"
        )
    if (points is None) == (board is None):
        raise ConfigError(
            "expected either POINTS.csv or a board on the floor (--image, --board, --near-left)"
        )
    if points is not None:
        points_cm, pixels_px = _read_points(points)
    else:
        points_cm, pixels_px = _board_points(image, frame, str(board), square, near_left)
    result = calibrate_ground(lens, points_cm, pixels_px)
    origin = f"{points.name}" if points is not None else f"board {board} on the floor"
    write_camera(
        out,
        result.camera,
        f"lens from {camera.name}; mounting from {int(result.used.sum())} ground points ({origin})",
        {**_figures(camera), **result.residuals},
        datetime.date.today().isoformat(),
    )
    pictures = []
    if frame is not None:
        marked = points_picture(frame, pixels_px, pixels_px - result.residuals_px)
        pictures = _road_pictures(out, result.camera, [marked], [frame])
    _show_mounting(result, points_cm, pixels_px)
    console.show_problems([] if image else ["without a photo there are no pictures; give --image"])
    console.wrote(out, *pictures)
    console.next_command("doctor", "--camera", out)


@app.command(
    "drive",
    epilog="Example: lanenet calibrate drive data/tub --lane-width 40 --wheelbase 26 --out runs/camera.yaml",
)
def drive_(
    drive: DriveArgument,
    out: _Out,
    lane_width: Annotated[
        float | None,
        typer.Option(
            parser=lane_cm,
            metavar="CM",
            help="Between the middles of the lane's two lines, cm: sets the scale.",
        ),
    ] = None,
    camera_height: Annotated[
        float | None,
        typer.Option(
            parser=length_cm,
            metavar="CM",
            help="Height of the lens above the road, cm: sets the scale instead.",
        ),
    ] = None,
    camera: Annotated[
        Path | None,
        typer.Option("--camera", help="Camera YAML to start from (--refine)."),
    ] = None,
    refine: Annotated[
        bool,
        typer.Option(
            "--refine", help="Refine --camera, or the drive's own camera, instead of searching for one."
        ),
    ] = False,
    accept_open_loop: Annotated[
        bool,
        typer.Option("--accept-open-loop", help="Accept a guessed focal length if no place is seen twice."),
    ] = False,
    wheelbase: WheelbaseOption = None,
    config: MappingOption = None,
) -> None:
    """Find lens and mounting from two laps alone: no board, no measured points."""
    from datagen.calibrate_drive import calibrate_drive, starting_camera
    from datagen.settings import MapSettings, with_wheelbase
    from lanenet.config import load_settings
    from lanenet.data.camera_file import write_camera

    check_ending(out, ".yaml", ".yml")
    check_not_source(drive, out)
    check_beside(out, *_pictures(out, *_ROAD_PICTURES))
    lock_outputs(out)
    settings = MapSettings() if config is None else load_settings(MapSettings, config)
    start, notes = starting_camera(drive, camera, refine)
    settings, start, note = with_wheelbase(settings, start, wheelbase)
    with console.progress_bar("calibrate") as progress:
        result = calibrate_drive(
            drive, lane_width, camera_height, start, settings, progress, accept_open_loop=accept_open_loop
        )
    today = datetime.date.today().isoformat()
    write_camera(out, result.camera, result.method, result.residuals, today)
    frames = [result.drive.image(k) for k in result.shown]
    pictures = _road_pictures(out, result.camera, frames, frames, _SMALL_PX_PER_CM)
    _show_drive(result)
    console.show_problems([*notes, *result.notes, *note])
    console.wrote(out, *pictures)
    width = "LANE_WIDTH" if lane_width is None else f"{lane_width:g}"
    console.next_command("map", drive, "--lane-width", width, "--camera", out, "--out", "MAP")


@app.command("print", epilog="Example: lanenet calibrate print --board 9x6 --square 2.5 --out runs/board.pdf")
def print_(
    out: Annotated[Path, typer.Option(help="PDF to write (.pdf).")],
    board: Annotated[str, typer.Option(help="Inner corners of the board, as 9x6.")] = "9x6",
    square: _Square = 2.5,
    paper: Annotated[Paper, typer.Option(help="Paper of the printer.")] = Paper.A4,
) -> None:
    """Draw a chessboard to print, and a sheet that places it on the floor before the car, at true scale."""
    from lanenet.calibration.chessboard import parse_board
    from lanenet.calibration.printed import calibration_pdf, near_left_cm
    from lanenet.data.files import write_bytes

    check_ending(out, ".pdf")
    lock_outputs(out)
    wanted = parse_board(board, square)
    write_bytes(out, calibration_pdf(wanted, paper))
    x_cm, y_cm = near_left_cm(wanted, paper)
    console.say(f"print at 100 %, and check the 10 cm; board on the floor: --near-left {x_cm:g},{y_cm:g}")
    console.wrote(out)
    console.next_command(
        "calibrate",
        "chessboard",
        "PHOTOS",
        "--board",
        board,
        "--square",
        f"{square:g}",
        "--out",
        "CAMERA.yaml",
    )


def _read_lens(path: Path) -> Camera:
    from lanenet.calibration.lens import NOMINAL_HEIGHT_CM
    from lanenet.data.camera_file import read_lens
    from lanenet.geometry.camera import NOMINAL_WHEELBASE_CM, Mounting

    return read_lens(path, Mounting(NOMINAL_HEIGHT_CM), NOMINAL_WHEELBASE_CM)


def _figures(path: Path) -> dict[str, float]:
    """Return the lens's residuals, which stay valid when only the mounting changes."""
    from lanenet.data.lens_file import foreign_lens

    # Other programs' figures have other names.
    if path.is_file() and foreign_lens(path) is not None:
        return {}
    found = read_yaml(path).get("residuals") or {}
    lens = ("rms_px", "worst_view_rms_px", "views_count", "seen_angle_rad")
    return {name: float(found[name]) for name in found if name in lens or name.endswith("_sigma_px")}


def _read_points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    from lanenet.data.tables import ColumnSpec, read_csv

    names = ("x_cm", "y_cm", "u_px", "v_px")
    table = read_csv(path, {name: ColumnSpec() for name in names}, CalibrationError)
    columns = [table[name] for name in names]
    return np.stack(columns[:2], axis=1), np.stack(columns[2:], axis=1)


def _board_points(
    image: Path | None, frame: np.ndarray | None, board: str, square_cm: float, near_left: str | None
) -> tuple[np.ndarray, np.ndarray]:
    from lanenet.calibration.chessboard import find_view, parse_board
    from lanenet.calibration.ground import points_of_floor_board

    if frame is None or near_left is None:
        raise ConfigError("a board on the floor needs --image PHOTO and --near-left X,Y")
    try:
        x_cm, y_cm = (float(word) for word in near_left.split(","))
    except ValueError:
        raise ConfigError(f"--near-left {near_left!r}: expected X,Y in cm, for example -10,25") from None
    wanted = parse_board(board, square_cm)
    view = find_view(str(image), frame, wanted)
    if isinstance(view, str):
        raise CalibrationError(f"{image}: {view}")
    return points_of_floor_board(view, wanted, (x_cm, y_cm))


def _lens_pictures(out: Path, result: ChessboardCalibration, turn: int) -> list[Path]:
    """Write the largest view undistorted, and its board from above; returns the paths."""
    from lanenet.calibration.chessboard import read_picture
    from lanenet.calibration.chessboard_camera import reprojected
    from lanenet.calibration.pictures import plane_picture, points_picture
    from lanenet.perception.edges.views import undistorting_view

    sizes = [float(np.prod(np.ptp(view.corners_px, axis=0))) for view in result.views]
    index = int(np.argmax(sizes))
    view = result.views[index]
    frame = read_picture(Path(view.name), turn)
    marked = points_picture(frame, view.corners_px, reprojected(result, index))
    (x0, y0), (x1, y1) = view.points_cm.min(axis=0), view.points_cm.max(axis=0)
    margin = 0.4 * max(x1 - x0, y1 - y0)
    area = (x0 - margin, y0 - margin, x1 + margin, y1 + margin)
    above = plane_picture(frame, result.camera, result.fit.poses[index], area)
    return _write_pictures(
        _pictures(out, *_LENS_PICTURES), undistorting_view(result.camera).of(marked), above
    )


def _road_pictures(
    out: Path, camera: Camera, marked: list[np.ndarray], frames: list[np.ndarray], scale: float | None = None
) -> list[Path]:
    """Write frames undistorted, with what is marked in them, and from above; returns the paths."""
    from lanenet.calibration.lens import pose_from_mounting
    from lanenet.calibration.pictures import plane_picture
    from lanenet.perception.edges.views import undistorting_view

    pose = pose_from_mounting(camera.mounting)
    flat = [undistorting_view(camera).of(frame) for frame in marked]
    above = [plane_picture(frame, camera, pose, _AREA_CM, scale) for frame in frames]
    pictures = (np.concatenate(flat, axis=1), np.concatenate(above, axis=1))
    return _write_pictures(_pictures(out, *_ROAD_PICTURES), *pictures)


def _pictures(out: Path, *names: str) -> list[Path]:
    return [out.with_name(f"{out.stem}-{name}.png") for name in names]


def _write_pictures(paths: list[Path], *pictures: np.ndarray) -> list[Path]:
    from lanenet.data.files import write_bytes
    from lanenet.data.tables import png_bytes

    for path, picture in zip(paths, pictures, strict=True):
        write_bytes(path, png_bytes(picture))
    return paths


def _show_lens(result: ChessboardCalibration, pictures: int) -> None:
    """Print a lens with its sigmas, and the RMS residual of each photo."""
    from lanenet.calibration.chessboard_camera import view_errors_px

    rows = [[Path(name).name, f"{rms:.3f}"] for name, rms in view_errors_px(result).items()]
    console.show_table("corners, measured minus projected", ("photo", "RMS px"), rows)
    K, s, D = result.camera.K, result.fit.lens_sigma, result.camera.D
    console.show_lines(
        [
            f"{result.camera.model} lens, {len(result.views)} of {pictures} photos used, "
            f"RMS {result.fit.rms_px:.3f} px",
            f"focal lengths   {K[0, 0]:.2f} +- {s[0]:.2f}   {K[1, 1]:.2f} +- {s[1]:.2f} px",
            f"principal point {K[0, 2]:.2f} +- {s[2]:.2f}   {K[1, 2]:.2f} +- {s[3]:.2f} px",
            "distortion      " + "  ".join(f"{d:.4f} +- {e:.4f}" for d, e in zip(D, s[4:], strict=True)),
        ]
    )


def _show_mounting(result: GroundCalibration, points_cm: np.ndarray, pixels_px: np.ndarray) -> None:
    """Print a mounting with its sigmas, and the points that were left out as outliers."""
    mounting, sigma = result.camera.mounting, result.sigma
    lines = [f"{int(result.used.sum())} of {len(result.used)} points used, RMS {result.rms_px:.2f} px"]
    for name in sigma:
        value, spread = getattr(mounting, name), sigma[name]
        label, _, unit = name.rpartition("_")
        if unit == "rad":
            value, spread, unit = np.rad2deg(value), np.rad2deg(spread), "degrees"
        lines.append(f"{label.replace('_', ' '):20s}{value:8.2f} +- {spread:.2f} {unit}")
    road_cm = result.camera.intersect_ground(pixels_px[result.used])
    worst = float(np.nanmax(np.linalg.norm(road_cm - points_cm[result.used], axis=1)))
    console.show_lines([*lines, f"{'worst point':20s}{worst:8.2f} cm off on the ground"])
    console.show_problems(
        [
            f"left out point {k + 1}: "
            + (
                "behind the camera or outside its field of view"
                if result.behind[k]
                else f"{np.linalg.norm(result.residuals_px[k]):.1f} px off"
            )
            for k in np.flatnonzero(~result.used)
        ]
    )


def _show_drive(result: CalibratedDrive) -> None:
    """Print a camera found from a drive with its sigmas; angles in degrees."""
    camera, m, sigma = result.camera, result.camera.mounting, result.sigma
    K, turn = camera.K, float(np.rad2deg(1.0))
    numbers = (
        ("focal length", K[0, 0], sigma["focal_px"], "px", 1),
        ("principal point, u", K[0, 2], sigma["cx_px"], "px", 1),
        ("principal point, v", K[1, 2], sigma["cy_px"], "px", 1),
        ("distortion k1", camera.D[0], sigma["k1"], "", 4),
        ("pitch, down", turn * m.pitch_down_rad, turn * sigma["pitch_down_rad"], "degrees", 2),
        ("roll", turn * m.roll_rad, turn * sigma["roll_rad"], "degrees", 2),
        ("yaw, to the left", turn * m.yaw_rad, turn * sigma["yaw_rad"], "degrees", 2),
        ("height", m.height_cm, sigma.get("height_cm"), "cm", 1),
        ("ahead of front axle", m.ahead_of_front_axle_cm, sigma["ahead_of_front_axle_cm"], "cm", 1),
    )
    rows = [
        [name, f"{value:.{digits}f}", "given" if spread is None else f"{spread:.{digits}f}", unit]
        for name, value, spread, unit, digits in numbers
    ]
    console.show_table(f"{camera.model} camera from {result.drive.name}", ("number", "found", "+-", ""), rows)
    lane = "no lane found" if result.lane_cm is None else f"lane {result.lane_cm:.1f} cm"
    console.show_lines(
        [
            f"{result.frames} frames, {result.revisits} places seen twice, edges agree to "
            f"{result.robust_sd_px:.2f} px (robust sd), {lane}"
        ]
    )
