"""Bad settings: YAML files, overrides, and the files of roads, each by the commands that read them."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest
import yaml
from bad_input import Bad, each
from commands import refused

from lanenet.config import Settings, load_settings
from lanenet.errors import ConfigError


class Inner(Settings):
    """A section."""

    blur_px: float = 1.0
    hold: bool = False


class Outer(Settings):
    """Settings with a section."""

    epochs: int = 1
    edges: Inner = Inner()


def settings(what: str, text: str | bytes | None, *named: str, overrides: tuple[str, ...] = ()) -> Bad:
    def act(folder: Path) -> Any:
        path = folder / "run.yaml"
        if text is not None:
            path.write_bytes(text.encode() if isinstance(text, str) else text)
        return load_settings(Outer, path, list(overrides))

    return Bad(what, act, ConfigError, named)


def pipe(folder: Path) -> Any:
    os.mkfifo(folder / "run.yaml")
    return load_settings(Outer, folder / "run.yaml")


NINE_TIMES = "a0: &a0 [1, 2]\n" + "".join(
    f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]\n" for k in range(1, 10)
)

BAD = [
    settings("no file", None, "run.yaml", "no such file"),
    settings("no text", b"\xff\xfe\x00\x81", "run.yaml"),
    settings("no YAML", "a: [1\nb: }\n", "run.yaml", "line 2"),
    settings("no mapping", "- 1\n- 2\n", "run.yaml", "mapping", "list"),
    settings("a misspelt key", "epoch: 3\n", "run.yaml", "'epoch'", "'epochs'"),
    settings("an unknown key of a section", "edges: {sharp: 1}\n", "'edges.sharp'", "blur_px"),
    settings("a wrong type", "epochs: many\n", "run.yaml", "'epochs'", "'many'"),
    settings("nan", "edges: {blur_px: .nan}\n", "'edges.blur_px'", "NaN"),
    settings("an override without a value", "", "key=value", "'epochs'", overrides=("epochs",)),
    settings("an override without a key", "", "key=value", "'=3'", overrides=("=3",)),
    settings("an override that is no YAML", "", "'epochs=['", "YAML", overrides=("epochs=[",)),
    settings("an override through a value", "epochs: 2\n", "'epochs.a=1'", overrides=("epochs.a=1",)),
    settings("yes for a number", "edges: {blur_px: yes}\n", "run.yaml", "'edges.blur_px'", "True"),
    settings("true for a whole number", "epochs: true\n", "run.yaml", "'epochs'", "True"),
    settings("a number for yes", "edges: {hold: 1}\n", "run.yaml", "'edges.hold'", "found 1"),
    settings("base sixty", "edges: {blur_px: 1:30}\n", "run.yaml", "'edges.blur_px'", "'1:30'"),
    settings("base eight", "epochs: 010\n", "run.yaml", "'epochs'", "'010'"),
    settings("an underscore", "epochs: 1_0\n", "run.yaml", "'epochs'", "'1_0'"),
    settings("a quoted number", "edges: {blur_px: '2'}\n", "run.yaml", "'edges.blur_px'", "'2'"),
    settings("a fraction of an epoch", "epochs: 2.0\n", "run.yaml", "'epochs'", "2.0"),
    settings("a key twice", "epochs: 1\nedges: {}\nepochs: 2\n", "run.yaml", "line 3", "'epochs'", "line 1"),
    settings("a key twice inside", "edges: {blur_px: 1, blur_px: 2}\n", "run.yaml", "line 1", "'blur_px'"),
    settings("no date", "epochs: 2024-13-45\n", "run.yaml"),
    settings("a number of 5000 digits", f"epochs: {'9' * 5000}\n", "run.yaml"),
    settings("nested deeply", "epochs: " + "[" * 50_000, "run.yaml"),
    settings("an alias of itself", "epochs: &a [*a]\n", "run.yaml", "aliases"),
    settings("aliases of aliases", NINE_TIMES, "run.yaml", "aliases"),
    settings("a hundred thousand values", f"epochs: [{'1,' * 100_000}]\n", "run.yaml", "10000"),
    settings("a large file", "# " + "x" * 2**21, "run.yaml", "1 MB"),
    settings("an override of yes", "", "'epochs'", "True", overrides=("epochs=yes",)),
    Bad("a folder", lambda f: load_settings(Outer, f), ConfigError, ("a folder",)),
    Bad(
        "a device", lambda f: load_settings(Outer, Path("/dev/zero")), ConfigError, ("/dev/zero", "a device")
    ),
    Bad("a pipe", pipe, ConfigError, ("run.yaml", "a pipe")),
    settings("a bad override", "", "run.yaml epochs=x", "'epochs'", overrides=("epochs=x",)),
]


@each(BAD)
def test_bad_settings_are_refused(tmp_path: Path, bad: Bad) -> None:
    bad.check(tmp_path)


def test_what_people_write_is_read(tmp_path: Path) -> None:
    path = tmp_path / "run.yaml"
    path.write_text("epochs: 0x10\nedges: &e {blur_px: 1e-3, hold: on}\n")
    found = load_settings(Outer, path, ["edges.hold=false"])
    assert (found.epochs, found.edges.blur_px, found.edges.hold) == (16, 0.001, False)


def config(tmp_path: Path, **changes: Any) -> Path:
    path = tmp_path / "run.yaml"
    data = {"name": "bad", "work_dir": str(tmp_path / "work"), "checkpoints_dir": str(tmp_path / "ck")}
    path.write_text(yaml.safe_dump(data | changes))
    return path


def test_a_misspelt_key_of_a_training_is_named_with_the_right_one(tmp_path: Path) -> None:
    line = refused(tmp_path, "train", config(tmp_path, learn={"epoch": 3}))
    assert "run.yaml" in line and "'learn.epoch'" in line and "'epochs'" in line


def test_a_wrong_type_in_an_override_of_a_training_is_named(tmp_path: Path) -> None:
    line = refused(tmp_path, "train", config(tmp_path), "learn.batch_size=many")
    assert "run.yaml" in line and "'learn.batch_size'" in line and "'many'" in line


def test_a_training_whose_drive_is_missing_makes_no_checkpoint(tmp_path: Path) -> None:
    drives = [{"path": str(tmp_path / "gone"), "lane_width_cm": 40}]
    line = refused(tmp_path, "train", config(tmp_path, data={"drives": drives}), writes="work")
    assert "gone" in line


STRAIGHT = {"straight": {"length_cm": 300}}


def bend(radius_cm, angle_deg, direction="left", **more):
    return {"arc": {"radius_cm": radius_cm, "angle_deg": angle_deg, "direction": direction, **more}}


#: What a road's file holds, and what the one line must name beside the file.
BAD_ROADS = {
    "a figure of eight": (
        {"pieces": [STRAIGHT, bend(80, 270), STRAIGHT, bend(80, 270, "right")]},
        ("pieces.0 (straight", "pieces.2 (straight", "meets itself"),
    ),
    "lanes that overlap": (
        {"pieces": [STRAIGHT, bend(70, 180), bend(70, 90), bend(70, 80)], "lanes": 2, "lane_width_cm": 40},
        ("pieces.", "meets itself"),
    ),
    "no radius left inside": (
        {"pieces": [STRAIGHT, bend(15, 90), STRAIGHT]},
        ("'pieces.1.arc.radius_cm'", "15"),
    ),
    "no lane": ({"lane_width_cm": 0}, ("'lane_width_cm'", "found 0")),
    "no tape": ({"line_width_cm": 0}, ("'line_width_cm'", "found 0")),
    "no dash": ({"right": {"kind": "dashed", "dash_cm": 0}}, ("'right.dash_cm'", "found 0")),
    "a misspelt key": ({"lane_wdth_cm": 40}, ("'lane_wdth_cm'", "'lane_width_cm'")),
    "an unknown key of a piece": (
        {"pieces": [STRAIGHT, bend(80, 90, colour="red")]},
        ("'pieces.1.arc.colour'", "radius_cm"),
    ),
    "an unknown piece": ({"pieces": [STRAIGHT, {"ark": {}}]}, ("'pieces.1.ark'", "'arc'")),
    "not a mapping": ([1, 2], ("mapping", "list")),
}
#: The car of the defaults turns 53.8 cm.
TOO_TIGHT = {"pieces": [STRAIGHT, bend(45, 90), {"straight": {"length_cm": 500}}]}


def road_words(tmp_path, verb, data):
    """The command by which a verb meets a road's file."""
    road, config = tmp_path / "road.yaml", tmp_path / "drive.yaml"
    road.write_text(yaml.safe_dump(data))
    config.write_text("frames: 3\ncamera: {width: 48, height: 36}\n")
    return {
        "track": ("track", road, "--out", tmp_path / "road.png"),
        "simulate": ("simulate", config, f"track.file={road}", "--out", tmp_path / "d"),
        "judge": ("judge", "--detectors", "truth", "--tracks", road, "--out", tmp_path / "j"),
    }[verb]


@pytest.mark.parametrize("verb", ["track", "simulate", "judge"])
@pytest.mark.parametrize("kind", BAD_ROADS)
def test_a_bad_road_is_refused_by_file_and_place(tmp_path, kind, verb):
    data, named = BAD_ROADS[kind]
    line = refused(tmp_path, *road_words(tmp_path, verb, data))
    for word in ("road.yaml", *named):
        assert word in line


@pytest.mark.parametrize("verb", ["simulate", "judge"])
def test_a_bend_that_the_car_cannot_turn_is_refused_by_piece_and_car(tmp_path, verb):
    line = refused(tmp_path, *road_words(tmp_path, verb, TOO_TIGHT))
    for word in ("road.yaml", "radius 45.0 cm", "pieces.1 (arc", "at least 53.8", "wheelbase 26 cm"):
        assert word in line


def test_a_road_that_is_too_short_for_the_drive_is_named(tmp_path):
    words = road_words(tmp_path, "simulate", {"pieces": [STRAIGHT]})
    line = refused(tmp_path, *words, "frames=300")
    assert "road.yaml" in line and "length_cm 300" in line and "fewer frames" in line


def test_the_other_lane_is_checked_where_it_is_driven(tmp_path):
    # 90 cm in the driven lane are 50 cm in the oncoming one, inside of a left bend.
    words = road_words(
        tmp_path, "simulate", {**TOO_TIGHT, "pieces": [STRAIGHT, bend(90, 90), STRAIGHT], "lanes": 2}
    )
    line = refused(tmp_path, *words, "driver.direction=backward")
    assert "radius 50.0 cm" in line and "road.yaml" in line
