"""Draws frames, windows and lengths for docs/frames.md and docs/measuring.md: ``make figures``.

All numbers come from the code. SVG with text as text, so that a test reads it and a diff shows changes.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("svg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Arc, FancyBboxPatch, Rectangle

from lanenet.control.steering import SteeringSettings
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.frames import map_from_car
from lanenet.geometry.lane import PARABOLA_FROM_POINTS, POINT_NAMES, POINTS_FROM_PARABOLA, ROWS_CM

#: One colour for each thing in all drawings; those of the reports: left blue, right red.
LEFT, RIGHT, CAR, QUIET, AIM = "#1f5fbf", "#c0392b", "#444444", "#888888", "#1e8449"
#: Chosen for the drawing: a lane of 40 cm, a car of 26 cm between the axles.
LANE_CM, WHEELBASE_CM = 40.0, 26.0
#: Behind a text that lies on other things.
PAPER = {"fc": "white", "ec": "none", "pad": 1.0}
#: x = a y^2 + b y + c of a lane that bends to the left, and the offset of the car in it, [cm].
BEND, OFFSET_CM = (-0.004, -0.05), 5.0


def main() -> None:
    """Write every drawing into the folder named on the command line."""
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    plt.rcParams.update({"svg.fonttype": "none", "svg.hashsalt": "lanenet", "font.family": "sans-serif"})
    for name, draw in DRAWINGS.items():
        figure = draw()
        figure.savefig(folder / f"{name}.svg", metadata={"Date": None, "Creator": None}, bbox_inches="tight")
        plt.close(figure)


def _axes(width_in: float, height_in: float, **limits: tuple[float, float]) -> tuple[Any, Any]:
    figure, axes = plt.subplots(figsize=(width_in, height_in))
    axes.set_aspect("equal")
    axes.set_axis_off()
    axes.set(**limits)
    return figure, axes


def _arrow(
    axes: Any, start: tuple[float, float], end: tuple[float, float], colour: str, style: str = "-|>"
) -> None:
    axes.annotate(
        "",
        end,
        start,
        arrowprops={"arrowstyle": style, "color": colour, "lw": 1.4, "shrinkA": 0, "shrinkB": 0},
    )


def _text(axes: Any, x: float, y: float, text: str, colour: str = CAR, **options: Any) -> None:
    axes.text(x, y, text, **{"color": colour, "fontsize": 9, "ha": "center", "va": "center", **options})


def _line_cm(y_cm: np.ndarray, side: int) -> np.ndarray:
    """x of the left (0) or the right (1) line of the drawn lane."""
    middle = BEND[0] * y_cm**2 + BEND[1] * y_cm + OFFSET_CM
    return np.asarray(middle + (side - 0.5) * LANE_CM)


def _car(axes: Any) -> None:
    """A car from above in its own frame: front axle at y = 0, rear axle one wheelbase behind."""
    axes.add_patch(
        FancyBboxPatch(
            (-6.0, -WHEELBASE_CM - 5.0),
            12.0,
            WHEELBASE_CM + 10.0,
            "round,pad=1,rounding_size=3",
            fc="#eeeeee",
            ec=CAR,
        )
    )
    for y in (0.0, -WHEELBASE_CM):
        axes.plot([-9.0, 9.0], [y, y], color=CAR, lw=1.5)
        for x in (-9.0, 9.0):
            axes.add_patch(Rectangle((x - 1.3, y - 3.3), 2.6, 6.6, color=CAR))


def car_frame() -> Any:
    """The frame car with the six labels, the parabolas and the aim point."""
    figure, axes = _axes(6.4, 6.0, xlim=(-46, 60), ylim=(-34, 54))
    _car(axes)
    y = np.linspace(-6.0, 50.0, 80)
    for side, colour in ((0, LEFT), (1, RIGHT)):
        axes.plot(_line_cm(y, side), y, color=colour, lw=5, alpha=0.25, solid_capstyle="butt")
        axes.plot(_line_cm(y, side), y, color=colour, lw=1, ls="--")
        rows = np.array(ROWS_CM)
        axes.plot(_line_cm(rows, side), rows, "o", color=colour, ms=6)
        for index, row in enumerate(ROWS_CM):
            x = float(_line_cm(np.array(row), side))
            name = POINT_NAMES[side * len(ROWS_CM) + index]
            _text(
                axes,
                x + (6.0 if side else -3.0),
                row + 3.0,
                name,
                colour,
                ha="left" if side else "right",
                family="monospace",
                fontsize=8,
            )
    for row in ROWS_CM:
        axes.axhline(row, color=QUIET, lw=0.6, ls=":")
        _text(axes, 60.0, row + 1.6, f"y = {row:g} cm", QUIET, ha="right", fontsize=8)
    ahead = SteeringSettings(wheelbase_cm=WHEELBASE_CM).look_ahead_cm
    aim = float(_line_cm(np.array(ahead), 0)) + 0.5 * LANE_CM
    axes.plot(aim, ahead, "*", color=AIM, ms=13)
    axes.plot([0, aim], [0, ahead], color=AIM, lw=1, ls="--")
    _text(axes, aim - 2.0, ahead + 4.0, "A, the\naim point", AIM, ha="right", fontsize=8)
    _arrow(axes, (0, 0), (34, 0), "black")
    _arrow(axes, (0, 0), (0, 46), "black")
    _text(axes, 36, -3.0, "x, to the right", "black", ha="left")
    _text(axes, 1.5, 48, "y, ahead", "black", ha="left")
    axes.plot(0, 0, "o", color="black", ms=5)
    _text(
        axes,
        13,
        -11,
        "origin: on the ground under\nthe middle of the front axle",
        "black",
        ha="left",
        fontsize=8,
    )
    _text(
        axes, 13, -WHEELBASE_CM, "rear axle: its middle\nis the pose in the map", CAR, ha="left", fontsize=8
    )
    return figure


def map_frame() -> Any:
    """The frame map with two poses of a car."""
    figure, axes = _axes(6.4, 3.8, xlim=(-12, 158), ylim=(-12, 88))
    theta = np.linspace(0.0, 1.35, 60)
    path = np.stack([20 + 90 * np.sin(theta), 10 + 90 * (1 - np.cos(theta))], axis=1)
    for side, colour in ((0.5, LEFT), (-0.5, RIGHT)):
        normal = np.stack([-np.sin(theta), np.cos(theta)], axis=1)
        axes.plot(*(path + side * LANE_CM * normal).T, color=colour, lw=4, alpha=0.4)
    axes.plot(*path.T, color=QUIET, lw=1, ls="--")
    for k in (12, 40):
        pose = np.array([*path[k], theta[k]])
        outline = np.array(
            [[-7, 5], [7, 5], [7, -WHEELBASE_CM - 5], [-7, -WHEELBASE_CM - 5], [-7, 5]], dtype=float
        )
        axes.plot(*map_from_car(outline, pose, WHEELBASE_CM).T, color=CAR)
        axes.plot(*pose[:2], "o", color="black", ms=4)
        tip = pose[:2] + 44 * np.array([np.cos(pose[2]), np.sin(pose[2])])
        _arrow(axes, tuple(pose[:2]), tuple(tip), "black")
        axes.plot([pose[0], pose[0] + 34], [pose[1]] * 2, color=QUIET, lw=0.8, ls=":")
        axes.add_patch(Arc(tuple(pose[:2]), 44, 44, theta1=0, theta2=np.rad2deg(pose[2]), color=AIM, lw=1.5))
        _text(
            axes,
            pose[0] + 24 * np.cos(pose[2] / 2) + 5,
            pose[1] + 24 * np.sin(pose[2] / 2),
            "heading",
            AIM,
            fontsize=8,
            ha="left",
        )
    _arrow(axes, (0, 0), (30, 0), "black")
    _arrow(axes, (0, 0), (0, 30), "black")
    _text(axes, 36, 0, "map x", "black", ha="left", fontsize=9)
    _text(axes, 0, 34, "map y", "black", fontsize=9)
    _text(
        axes,
        140,
        20,
        "pose: x, y of the rear axle's middle,\nheading counter-clockwise from x",
        "black",
        fontsize=8,
    )
    return figure


def windows() -> Any:
    """The bird's-eye windows of the shipped networks over a lane."""
    figure, (drawing, cells) = plt.subplots(1, 2, figsize=(8.2, 4.6), width_ratios=(1.5, 1.0))
    for axes in (drawing, cells):
        axes.set_aspect("equal")
        axes.set_axis_off()
    _car(drawing)
    y = np.linspace(-10.0, 100.0, 120)
    for side, colour in ((0, LEFT), (1, RIGHT)):
        drawing.plot((side - 0.5) * LANE_CM + 0.0015 * y**2, y, color=colour, lw=4, alpha=0.35)
    for window, name, colour in (
        (BirdseyeWindow(), "small, and the default", "black"),
        (BirdseyeWindow(left_cm=-64.0, cell_cm=1.0), "general", AIM),
    ):
        size = (window.right_cm - window.left_cm, window.far_cm - window.near_cm)
        drawing.add_patch(Rectangle((window.left_cm, window.near_cm), *size, fill=False, ec=colour, lw=1.6))
        text = f"{name}: {size[0]:g} x {size[1]:g} cm, cells of {window.cell_cm:g} cm"
        _text(drawing, 0, window.far_cm - 6.0, text, colour, fontsize=7, bbox=PAPER)
    for row in ROWS_CM:
        drawing.plot([-64, 64], [row, row], color=QUIET, lw=0.6, ls=":")
        _text(drawing, 66, row, f"{row:g}", QUIET, fontsize=8, ha="left")
    _text(drawing, 66, ROWS_CM[-1] + 8, "label\nrows, cm", QUIET, fontsize=7, ha="left")
    drawing.set(xlim=(-70, 84), ylim=(-34, 104))
    window = BirdseyeWindow()
    for k in range(7):
        cells.plot([0, 6], [k, k], color=QUIET, lw=0.7)
        cells.plot([k, k], [0, 6], color=QUIET, lw=0.7)
    cells.add_patch(Rectangle((0, 5), 1, 1, color="#dddddd"))
    corner = window.points(np.array([[0.0, 0.0]]))[0]
    cells.plot(0.5, 5.5, "o", color="black", ms=4)
    _text(
        cells,
        0.0,
        6.9,
        f"row 0, column 0: its centre lies\nat x = {corner[0]:g}, y = {corner[1]:g} cm",
        "black",
        fontsize=8,
        ha="left",
    )
    _arrow(cells, (-0.6, 6), (-0.6, 3), "black")
    _text(cells, -1.0, 4.5, "rows", "black", fontsize=8, rotation=90)
    _arrow(cells, (0, -0.6), (3, -0.6), "black")
    _text(cells, 1.5, -1.2, "columns", "black", fontsize=8)
    _text(cells, 3.0, -2.2, f"{window.rows} x {window.columns} cells, far edge first", QUIET, fontsize=8)
    cells.set(xlim=(-2, 7.5), ylim=(-3, 8))
    return figure


def camera_side() -> Any:
    """The mounting of the camera from the side."""
    figure, axes = _axes(7.0, 2.6, xlim=(-48, 82), ylim=(-9, 38))
    axes.plot([-48, 82], [0, 0], color=QUIET, lw=2)
    for x in (0.0, -WHEELBASE_CM):
        axes.add_patch(plt.Circle((x, 3.3), 3.3, color=CAR))
    axes.add_patch(
        FancyBboxPatch(
            (-WHEELBASE_CM - 6, 4.0), WHEELBASE_CM + 13, 4.0, "round,pad=0.6", fc="#eeeeee", ec=CAR
        )
    )
    height, ahead, pitch = 22.0, -5.0, np.deg2rad(20.0)
    axes.plot([ahead, ahead], [8, height], color=CAR, lw=3)
    axes.plot(ahead, height, "s", color="black", ms=9)
    axes.plot([ahead, 60], [height, height], color=QUIET, lw=0.8, ls=":")
    length = 58.0
    _arrow(axes, (ahead, height), (ahead + length * np.cos(pitch), height - length * np.sin(pitch)), "black")
    axes.add_patch(Arc((ahead, height), 70, 70, theta1=-20, theta2=0, color=AIM, lw=1.6))
    _text(axes, ahead + 40, height - 5.0, "pitch_down_rad", AIM, fontsize=8, ha="left", family="monospace")
    _arrow(axes, (-20, 0), (-20, height), LEFT, "<|-|>")
    axes.plot([-20, ahead], [height, height], color=LEFT, lw=0.8, ls=":")
    _text(axes, -21.5, 16, "height_cm", LEFT, fontsize=8, ha="right", family="monospace")
    axes.plot([0, 0], [0, 31], color=QUIET, lw=0.8, ls=":")
    _arrow(axes, (ahead, 28), (0, 28), RIGHT, "<|-|>")
    axes.plot([ahead, ahead], [height, 29], color=QUIET, lw=0.8, ls=":")
    _text(
        axes,
        2,
        31,
        "ahead_of_front_axle_cm (here negative)",
        RIGHT,
        fontsize=8,
        ha="left",
        family="monospace",
    )
    _arrow(axes, (-WHEELBASE_CM, -4), (0, -4), CAR, "<|-|>")
    _text(axes, -WHEELBASE_CM / 2, -7, "wheelbase_cm", CAR, fontsize=8, family="monospace")
    _arrow(axes, (0, 0), (78, 0), "black")
    _text(axes, 78, -4, "y", "black")
    return figure


def lane_width() -> Any:
    """What to measure: middle to middle of the lines that bound the driven lane, on three roads."""
    figure, rows = plt.subplots(3, 1, figsize=(7.2, 5.6))
    roads = (
        ("Two lines: between the middles of the tape.", (0, 40), (), (0, 1), 20),
        ("A dashed middle line: the lane is half of the road.", (0, 40, 80), (1,), (1, 2), 60),
        (
            "Five lines: the two beside the car's path, whatever else is printed.",
            (0, 5, 42, 79, 84),
            (2,),
            (2, 3),
            60.5,
        ),
    )
    for axes, (title, lines, dashed, (first, second), car) in zip(rows, roads, strict=True):
        axes.set_aspect("equal")
        axes.set_axis_off()
        axes.set(xlim=(-8, 94), ylim=(-6, 27))
        axes.add_patch(Rectangle((-6, 0), 98, 20, color="#e6e6e6"))
        for index, x in enumerate(lines):
            spans = ((1, 8), (12, 19)) if index in dashed else ((0, 20),)
            for low, high in spans:
                colour = "#d4a800" if index in dashed else "white"
                axes.add_patch(Rectangle((x - 1.0, low), 2.0, high - low, fc=colour, ec=QUIET, lw=0.6))
        axes.add_patch(FancyBboxPatch((car - 4, 2), 8, 9, "round,pad=0.5", fc="#bbbbbb", ec=CAR))
        _text(axes, car, 6.5, "car", "black", fontsize=8)
        _arrow(axes, (lines[first], 15.5), (lines[second], 15.5), AIM, "<|-|>")
        _text(
            axes,
            car,
            17.8,
            f"--lane-width {lines[second] - lines[first]:g}",
            AIM,
            fontsize=8,
            family="monospace",
        )
        for index in (first, second):
            axes.plot([lines[index]] * 2, [-3, 20], color=AIM, lw=0.8, ls=":")
        axes.text(-6, 23, title, fontsize=9, ha="left", va="center")
    figure.subplots_adjust(hspace=0.05)
    return figure


def parabola() -> Any:
    """Three points of a line and the parabola through them."""
    figure, axes = plt.subplots(figsize=(4.6, 3.2))
    points = np.array([-19.0, -20.8, -25.4])
    a, b, c = PARABOLA_FROM_POINTS @ points
    assert np.allclose(POINTS_FROM_PARABOLA @ [a, b, c], points)
    y = np.linspace(0, 36, 50)
    axes.plot(a * y**2 + b * y + c, y, color=LEFT)
    axes.plot(points, ROWS_CM, "o", color=LEFT)
    for x, row in zip(points, ROWS_CM, strict=True):
        axes.text(x + 0.5, row, f"{x:g}", color=LEFT, fontsize=8, va="center")
    axes.set(xlabel="x, cm (to the right)", ylabel="y, cm (ahead)", xlim=(-30, -14), yticks=ROWS_CM)
    axes.set_title(f"x = {a:.4f} y² {b:+.3f} y {c:+.1f}", fontsize=9)
    axes.grid(alpha=0.3)
    return figure


DRAWINGS: dict[str, Callable[[], Any]] = {
    "car_frame": car_frame,
    "map_frame": map_frame,
    "windows": windows,
    "camera_side": camera_side,
    "lane_width": lane_width,
    "parabola": parabola,
}

if __name__ == "__main__":
    main()
