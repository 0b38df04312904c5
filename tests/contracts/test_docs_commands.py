"""The command lines of the documents run as they stand, in a folder that holds a small one of all they read.

Where a command takes minutes, options that make it small are added to its end: the last one of a name counts.
What is not run is named in ``NOT_RUN`` with the reason; its verbs, options, targets and files are checked.
"""

from __future__ import annotations

import re
import runpy
import shlex
import shutil
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from bags import START_NS, STEP_NS, ackermann, compressed, write_bag
from chessboards import BOARD, board_poses, fisheye_of, painted
from documents import DOCUMENTS, REPO, VERBS, Command, commands_of, inline_commands, unmarked_blocks
from PIL import Image
from typer.testing import CliRunner

from lanenet.calibration.printed import Paper, near_left_cm
from lanenet.cli.app import app
from lanenet.data.camera_file import read_camera
from lanenet.data.drives import open_drive
from lanenet.data.maps.joined import FORMAT, JoinedDrive, JoinedMeta, write_joined

COMMANDS = [command for document in DOCUMENTS for command in commands_of(document)]
#: Fewer give no map.
FRAMES = 60
#: What is not run, and why.
NOT_RUN = {
    r"(?!lanenet )": "not a command of lanenet: installs packages, changes the computer or takes minutes",
    r"lanenet (drive|stop|doctor) .*(picamera|\bcar\.yaml)": "needs a car",
    r"lanenet .*(--push|\bhf:)": "needs an account on the Hugging Face Hub; run with a folder in test_hub.py",
    r"lanenet label-all .*--address": "needs a Ray cluster; run in tests/sim/test_fleet_on_a_cluster.py",
    r"lanenet join": "needs two drives of a closed road; run in tests/sim/test_join.py",
    r"lanenet calibrate drive": "needs two laps; run in tests/sim/test_calibrate_drive.py",
    r"lanenet .*--rerun live": "opens a viewer's window",
}
#: What stands in ``slow`` takes longer than the gate has time for, or another test does the same: the chain
#: trains by `train` in the gate, tests/unit/fleet runs `label-all`, other lines map, export and compare.
SLOW = (
    r"lanenet (train|sweep|judge|reality|sheets \w+|label-all|export .*--out|val .*--(robust|all)"
    r"|map (runs/drive7|monday_tub|tuesday_tub|.*--tape-width))\b"
)
#: A file's time may be that of the clock's last tick. Chosen: ten ticks of a slow one.
CLOCK_STEP_NS = 10**8
#: What makes a command small.
SMALLER = {
    "simulate": f"frames={FRAMES}",
    # One of the configs trains what lies there as a copy of the general network.
    "train": "--force learn.epochs=1 learn.threads=1 data.workers=1",
    "sweep": "--trials 1 --minutes 2",
    "bench": "--rounds 10",
    "judge": "--count 1 --laps 1",
    "reality": "--count 2",
    "sheets": "paper",
}


def check_options(line: str) -> None:
    """Refuse a command line with a verb or an option that does not exist."""
    words = shlex.split(line)[1:]
    if words and words[0].startswith("-"):
        assert words[0] in ("--help", "--version", "--install-completion"), line
        return
    names = tuple(words[:2]) if tuple(words[:2]) in VERBS else tuple(words[:1])
    groups = {name[0] for name in VERBS if len(name) > 1}
    assert names in VERBS or (len(words) == 1 and words[0] in groups), f"no such verb: {line}"
    known = (
        {option for parameter in VERBS[names].params for option in parameter.opts}
        if names in VERBS
        else set()
    )
    for word in words:
        if word.startswith("--"):
            assert word.partition("=")[0] in {*known, "--help"}, f"{word} is no option of {' '.join(names)}"


def why_not_run(line: str) -> str:
    return next((reason for pattern, reason in NOT_RUN.items() if re.match(pattern, line)), "")


RUN = list(dict.fromkeys(command.line for command in COMMANDS if not why_not_run(command.line)))
LEFT_OUT = [command for command in COMMANDS if why_not_run(command.line)]


def tiny(config: dict[str, Any]) -> dict[str, Any]:
    """A training config of the same keys with next to no data."""
    data = config["data"]
    if "synthetic" in data:
        # Of this seed, roads that are seen for so short a while show both lines.
        parts = dict.fromkeys(("train", "validation", "test"), 1)
        data["synthetic"] = {"seed": 3, **parts, "simulation": {"frames": FRAMES}}
    for drive in data.get("drives", ()):
        drive.pop("map", None)
        drive.pop("gap_cm", None)
        drive |= {"split": "time", "gap_frames": 2}
    return config


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project folder with a small drive, its map, its labels, photos of a board and small configs."""
    project = tmp_path_factory.mktemp("documents") / "project"
    shutil.copytree(REPO / "configs", project / "configs")
    shutil.copytree(REPO / "checkpoints", project / "checkpoints")
    for path in (project / "configs" / "judge").glob("*.yaml"):
        # A number for each kind of road goes before --count.
        config = yaml.safe_load(path.read_text(encoding="utf-8"))
        path.write_text(yaml.safe_dump(config | {"counts": {}}), encoding="utf-8")
    example = "lanenet simulate configs/drives/example.yaml"
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(project)
        invoke(f"{example} frames={FRAMES} --out runs/drive7")
        invoke("lanenet map runs/drive7 --lane-width 40 --out runs/my_map")
        invoke("lanenet label runs/my_map --out runs/my_labels.parquet")
        for path in (project / "configs").glob("*.yaml"):
            config = yaml.safe_load(path.read_text(encoding="utf-8"))
            if "data" in config:
                path.write_text(yaml.safe_dump(tiny(config)), encoding="utf-8")
        invoke(f"{example} frames={FRAMES} track.lane_width_cm=59 --out donkey_tub")
    drive = project / "runs" / "drive7"
    # The line of the documents shows its last frames.
    count_from(940, project / "donkey_tub" / "frames.csv")
    for name in ("my_tub", "other_tub", "monday_tub", "tuesday_tub"):
        shutil.copytree(drive, project / name)
    for name in ("my_tub", "other_tub"):
        library = project / "drives.sqlite"
        invoke(f"lanenet drives add {project / name} --library {library} --lane-width 40 --force")
    # Its drives lie relative to its folder, to which it is copied back.
    shutil.move(project / "drives.sqlite", project.parent)
    shutil.copytree(drive, project / "runs" / "drive8")
    write_track(project / "runs" / "track", project / "runs" / "my_map")
    shutil.copytree(project / "checkpoints" / "general", project / "checkpoints" / "donkey")
    for copy in (project / "runs", project / "checkpoints" / "donkey"):
        shutil.copy(drive / "camera.yaml", copy / "camera.yaml")
    shutil.copy(project / "checkpoints" / "small" / "model.onnx", project / "alexnet.onnx")
    shutil.copytree(project / "runs", project.parent / "runs")
    write_video(project / "road.mp4", sorted(drive.rglob("*.jpg")))
    write_recordings(project, drive)
    write_floor_points(project / "floor_points.csv", drive / "camera.yaml")
    write_photos(project / "photos")
    write_floor_photo(project / "floor.jpg", drive / "camera.yaml")
    return project


def count_from(first: int, table: Path) -> None:
    """Number the frames of a drive from another one on, as in a part of a recording."""
    head, *rows = table.read_text(encoding="utf-8").splitlines()
    cells = [row.split(",", 1) for row in rows]
    numbered = [f"{first + int(frame)},{rest}" for frame, rest in cells]
    table.write_text("\n".join([head, *numbered]) + "\n", encoding="utf-8")


def write_track(track: Path, one_map: Path) -> None:
    """A folder as ``join`` leaves it, of two drives that have the same map."""
    drives = []
    for name in ("monday", "tuesday"):
        shutil.copytree(one_map, track / name)
        how = {"x_cm": 0.0, "y_cm": 0.0, "turn_rad": 0.0, "scale": 1.0, "opposite": False}
        drives.append(JoinedDrive(map=name, made_from=f"runs/{name}", **how))
    write_joined(track, JoinedMeta(format=FORMAT, shared_camera=True, drives=tuple(drives)))


def write_recordings(project: Path, path: Path) -> None:
    """A drive as a ROS 2 bag and as an MCAP file."""
    drive = open_drive(path)
    times = [START_NS + k * STEP_NS for k in range(len(drive))]
    speed_cm_s, steering_rad = drive.commands.speed_cm_s, drive.commands.steering_rad
    assert speed_cm_s is not None and steering_rad is not None
    topics = {
        "/camera": [(t, compressed(drive.image(k), t)) for k, t in enumerate(times)],
        "/drive": [
            (t, ackermann(0.01 * float(speed_cm_s[k]), float(steering_rad[k]), t))
            for k, t in enumerate(times)
        ],
    }
    write_bag(project / "my_bag", topics)
    shutil.copy(write_bag(project / "clip", topics, "mcap") / "clip.mcap", project)


def write_video(path: Path, images: list[Path]) -> None:
    frames = [cv2.imread(str(image)) for image in images]
    height, width = frames[0].shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 20.0, (width, height))
    for frame in frames:
        writer.write(frame)
    writer.release()


def write_floor_points(path: Path, camera_file: Path) -> None:
    x_cm, y_cm = np.meshgrid([-20.0, 0.0, 20.0], [25.0, 35.0, 50.0])
    points_cm = np.stack([x_cm.ravel(), y_cm.ravel()], axis=1)
    table = np.hstack([points_cm, read_camera(camera_file).project_ground(points_cm)])
    np.savetxt(path, table, fmt="%.2f", delimiter=",", header="x_cm,y_cm,u_px,v_px", comments="")


def write_photos(path: Path) -> None:
    path.mkdir()
    rng = np.random.default_rng(2)
    camera = fisheye_of(120.0, rng)
    for number, (rotation, centre) in enumerate(board_poses(camera, rng, 8)):
        cv2.imwrite(str(path / f"{number}.jpg"), painted(camera, rotation, centre, rng))


def write_floor_photo(path: Path, camera_file: Path) -> None:
    """The board at the far edge of the floor sheet, seen by the drive's camera."""
    camera = read_camera(camera_file)
    near = np.array([*near_left_cm(BOARD, Paper.A4), 0.0])
    middle = near + 0.5 * BOARD.square_cm * np.array([BOARD.columns - 1, BOARD.rows - 1, 0.0])
    rotation = camera.mounting.camera_from_car
    centre = rotation @ (middle - camera.mounting.position_car_cm)
    cv2.imwrite(str(path), painted(camera, rotation, centre, np.random.default_rng(0)))


def invoke(line: str) -> str:
    result = CliRunner().invoke(app, shlex.split(line)[1:])
    assert result.exit_code == 0, f"{line}\n{result.output}\n{result.exception!r}"
    return result.output


@pytest.mark.parametrize(
    "line",
    [pytest.param(line, id=line, marks=pytest.mark.slow if re.match(SLOW, line) else ()) for line in RUN],
)
def test_the_command_runs(line: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # No line needs what another one has left.
    shutil.rmtree(folder / "runs")
    shutil.copytree(folder.parent / "runs", folder / "runs")
    shutil.copy(folder.parent / "drives.sqlite", folder)
    monkeypatch.chdir(folder)
    verb = line.split()[1]
    # What the line before it in the README trains.
    shutil.rmtree("checkpoints/mycar", ignore_errors=True)
    if verb != "train":
        shutil.copytree("checkpoints/donkey", "checkpoints/mycar")
    written = re.findall(r"--(?:out|video) (\S+)", line)
    if verb == "map":
        # The map of another drive would not be replaced.
        shutil.rmtree(written[0], ignore_errors=True)
    made_before = time.time_ns()
    smaller = SMALLER.get(verb, "")
    if re.match(r"lanenet train \w+_tub", line):
        # The parts of so short a drive lie within the usual gaps.
        smaller += " data.drives.0.gap_frames=2 data.drives.0.gap_cm=0"
    assert invoke(" ".join([line, smaller]))
    for path in written:
        # Some write several files that begin with the name.
        beginning = path.removesuffix(".parquet")
        newest = max((made.stat().st_mtime_ns for made in Path().glob(f"{beginning}*")), default=0)
        assert newest > made_before - CLOCK_STEP_NS, f"{line}: did not write {path}"


def test_the_moving_picture_shows_photos_with_the_lane_beside_the_map(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``make pictures`` without its map."""
    monkeypatch.chdir(folder)
    out = folder / "drive.webp"
    words = [str(folder.parent / "runs" / "my_map"), str(out), "--frames", "10:15"]
    monkeypatch.setattr("sys.argv", ["pictures.py", *words])
    runpy.run_path(str(REPO / "contrib" / "pictures.py"), run_name="__main__")
    with Image.open(out) as picture:
        assert picture.n_frames == 3
        image, view = np.split(np.asarray(picture.convert("RGB")).astype(int), [3 * 320], axis=1)
    for part in (image, view):
        # The network's lines: green on the left, orange on the right.
        red, green, blue = (part[..., k] for k in range(3))
        left = np.argwhere((green > red + 60) & (green > blue + 60))
        right = np.argwhere((red > green + 60) & (green > blue + 40))
        assert len(left) > 20 and len(right) > 20
    # The image is dark, the map pale.
    assert np.median(image) < 200 < np.median(view)


@pytest.mark.parametrize("command", LEFT_OUT, ids=lambda command: command.line)
def test_what_is_not_run_names_what_exists(command: Command) -> None:
    targets = set(re.findall(r"^([\w-]+):", (REPO / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    for part in command.line.split("&&"):
        words = [word for word in shlex.split(part) if word != "sudo"]
        program = Path(words[0]).name
        if program == "lanenet":
            check_options(shlex.join(["lanenet", *words[1:]]))
        elif program == "make":
            named = [word for word in words[1:] if "=" not in word]
            assert set(named) <= targets, part
        elif program in ("python", "python3") and words[1].endswith(".py"):
            assert (REPO / words[1]).is_file(), part
        for word in words:
            if word.startswith("contrib/"):
                assert (REPO / word).exists(), part


def test_every_reason_is_needed() -> None:
    lines = [command.line for command in COMMANDS]
    for pattern in (*NOT_RUN, SLOW):
        assert [line for line in lines if re.match(pattern, line)], pattern
    assert {line.split()[1] for line in RUN} >= SMALLER.keys()


def test_most_commands_of_lanenet_are_run() -> None:
    verbs = {line.split()[1] for line in RUN}
    assert {names[0] for names in VERBS} - verbs == {"join", "stop"}


def test_commands_read_and_write_below_the_folder_they_run_in() -> None:
    assert not [command for command in COMMANDS if "../" in command.line]


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.relative_to(REPO).as_posix())
def test_commands_in_the_text_name_what_exists(document: Path) -> None:
    for line in inline_commands(document):
        check_options(line)


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.relative_to(REPO).as_posix())
def test_command_lines_stand_in_blocks_that_are_run(document: Path) -> None:
    assert not unmarked_blocks(document)


@pytest.mark.parametrize("line", ["lanenet trian x", "lanenet map my_tub --width 40"])
def test_what_does_not_exist_is_found(line: str) -> None:
    with pytest.raises(AssertionError, match=r"no such verb|is no option"):
        check_options(line)
