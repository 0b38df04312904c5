"""The verbs below ``lanenet calibrate``: thin shells over :mod:`lanenet.calibration` and ``datagen``."""

from __future__ import annotations

import datetime
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer

from lanenet.cli import console
from lanenet.cli.calibrate_show import ground_pictures, lens_pictures, show_lens, show_mounting
from lanenet.cli.outputs import check_not_source
from lanenet.config import read_yaml
from lanenet.errors import CalibrationError, ConfigError

if TYPE_CHECKING:
    from lanenet.geometry.camera import Camera

app = typer.Typer(no_args_is_help=True, help="Find the camera: its lens, and where it sits on the car.")

_Board = Annotated[
    str | None, typer.Option(help="Inner corners of the board, for example 9x6.", show_default=False)
]
_Square = Annotated[float, typer.Option(min=0.01, help="Side of a square, cm.")]
_Out = Annotated[Path, typer.Option(help="Camera file to write (.yaml).", show_default=False)]


class LensModel(StrEnum):
    """Lens models of ``lanenet calibrate chessboard``."""

    AUTO = "auto"
    FISHEYE = "fisheye"
    PINHOLE = "pinhole"


@app.command(epilog="Example: lanenet calibrate chessboard photos/*.jpg --board 9x6 --out runs/camera.yaml")
def chessboard(
    images: Annotated[
        list[str], typer.Argument(metavar="IMAGES", help="Photos, patterns or folders.", show_default=False)
    ],
    board: Annotated[str, typer.Option(help="Inner corners of the board, as 9x6.", show_default=False)],
    out: _Out,
    square: _Square = 2.5,
    model: Annotated[
        LensModel, typer.Option(help="Lens; auto takes the one with more evidence.")
    ] = LensModel.AUTO,
    height: Annotated[
        float | None, typer.Option(min=0.1, help="Height of the lens above the ground, cm.")
    ] = None,
    pitch: Annotated[float | None, typer.Option(help="Downward tilt of the camera, degrees.")] = None,
    wheelbase: Annotated[float | None, typer.Option(min=0.1, help="Distance of the car's axles, cm.")] = None,
    ros: Annotated[Path | None, typer.Option(help="Also write a ROS camera_info file (.yaml).")] = None,
) -> None:
    """Find a camera's lens from photos of a chessboard held in different tilts and places."""
    from lanenet.calibration.chessboard import find_views, list_pictures, parse_board
    from lanenet.calibration.chessboard_camera import calibrate_lens
    from lanenet.calibration.lens import NOMINAL_HEIGHT_CM, NOMINAL_WHEELBASE_CM
    from lanenet.data.camera_file import write_camera, write_ros_camera_info
    from lanenet.geometry.camera import Mounting

    _check_yaml(out, ros)
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
    # Written by hand or not at all: only `calibrate ground` measures the mounting.
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
    pictures = lens_pictures(out, result)
    left_out = {**left_out, **result.dropped}
    show_lens(result, len(paths))
    console.show_problems([f"left out {name}: {reason}" for name, reason in left_out.items()], limit=100)
    console.show_problems(notes)
    console.wrote(out, ros, *pictures)
    console.next_command("calibrate", "ground", "POINTS.csv", "--camera", out, "--out", out)


@app.command(
    epilog="Example: lanenet calibrate ground points.csv --camera runs/camera.yaml --out runs/camera.yaml"
)
def ground(
    camera: Annotated[
        Path, typer.Option("--camera", help="Camera YAML, or ROS camera_info.", show_default=False)
    ],
    out: _Out,
    points: Annotated[
        Path | None,
        typer.Argument(
            metavar="POINTS.csv", help="Columns x_cm, y_cm (right, ahead), u_px, v_px.", show_default=False
        ),
    ] = None,
    image: Annotated[
        Path | None, typer.Option(help="Photo of the ground: for the pictures, and of the board.")
    ] = None,
    board: _Board = None,
    square: _Square = 2.5,
    near_left: Annotated[
        str | None,
        typer.Option(help="Board's inner corner near the car on the left, as X,Y in cm.", show_default=False),
    ] = None,
    wheelbase: Annotated[float | None, typer.Option(min=0.1, help="Distance of the car's axles, cm.")] = None,
) -> None:
    """Find where the camera sits, from points on the ground or from a board that lies there (--board)."""
    from dataclasses import replace

    from lanenet.calibration.chessboard import read_picture
    from lanenet.calibration.ground import calibrate_ground
    from lanenet.data.camera_file import write_camera

    _check_yaml(out)
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
    pictures = [] if frame is None else ground_pictures(out, frame, result, pixels_px)
    show_mounting(result, points_cm, pixels_px)
    console.show_problems([] if image else ["no pictures without a photo; give --image"])
    console.wrote(out, *pictures)
    console.next_command("doctor", "--camera", out)


@app.command(
    "drive",
    epilog="Example: lanenet calibrate drive data/tub --lane-width 40 --wheelbase 26 --out runs/camera.yaml",
)
def drive_(
    drive: Annotated[Path, typer.Argument(metavar="DRIVE", help="Drive, tub or video.", show_default=False)],
    out: _Out,
    lane_width: Annotated[
        float | None,
        typer.Option(min=1.0, help="Between the middles of the lane's two lines, cm: sets the scale."),
    ] = None,
    camera_height: Annotated[
        float | None,
        typer.Option(min=0.1, help="Height of the lens above the road, cm: sets the scale instead."),
    ] = None,
    camera: Annotated[
        Path | None,
        typer.Option("--camera", help="Camera YAML to begin with (--refine).", show_default=False),
    ] = None,
    refine: Annotated[
        bool, typer.Option("--refine", help="Refine --camera, or the drive's own, instead of a search.")
    ] = False,
    accept_open_loop: Annotated[
        bool, typer.Option("--accept-open-loop", help="Take a guessed focal length where no place recurs.")
    ] = False,
    wheelbase: Annotated[float | None, typer.Option(min=0.1, help="Distance of the car's axles, cm.")] = None,
    config: Annotated[Path | None, typer.Option(help="YAML with the mapping's settings.")] = None,
) -> None:
    """Find lens and mounting from two laps alone: no board, no measured points."""
    from datagen.calibrate_drive import calibrate_drive, starting_camera
    from datagen.settings import MapSettings, with_wheelbase
    from lanenet.cli.calibrate_show import drive_pictures, show_drive
    from lanenet.config import load_settings
    from lanenet.data.camera_file import write_camera

    _check_yaml(out)
    check_not_source(drive, out)
    settings = MapSettings() if config is None else load_settings(MapSettings, config)
    start, notes = starting_camera(drive, camera, refine)
    settings, start, note = with_wheelbase(settings, start, wheelbase)
    with console.progress_bar("calibrate") as progress:
        result = calibrate_drive(
            drive, lane_width, camera_height, start, settings, progress, accept_open_loop=accept_open_loop
        )
    today = datetime.date.today().isoformat()
    write_camera(out, result.camera, result.method, result.residuals, today)
    pictures = drive_pictures(out, result)
    show_drive(result)
    console.show_problems([*notes, *result.notes, *note])
    console.wrote(out, *pictures)
    width = "LANE_WIDTH" if lane_width is None else f"{lane_width:g}"
    console.next_command("map", drive, "--lane-width", width, "--camera", out, "--out", "MAP")


def _check_yaml(*paths: Path | None) -> None:
    for path in paths:
        if path is not None and path.suffix.lower() not in (".yaml", ".yml"):
            raise ConfigError(f"{path}: expected a name that ends in .yaml")


def _read_lens(path: Path) -> Camera:
    from lanenet.calibration.lens import NOMINAL_HEIGHT_CM, NOMINAL_WHEELBASE_CM
    from lanenet.data.camera_file import read_camera, read_ros_camera_info
    from lanenet.geometry.camera import Mounting

    if path.is_file() and "camera_matrix" in read_yaml(path):
        return read_ros_camera_info(path, Mounting(NOMINAL_HEIGHT_CM), NOMINAL_WHEELBASE_CM)
    return read_camera(path)


def _figures(path: Path) -> dict[str, float]:
    """Figures of the lens, kept when only the mounting changes."""
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
