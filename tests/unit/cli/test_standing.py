"""``lanenet`` alone: what lies in a folder, and what comes next."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from drives import record, write_drive, write_tub
from typer.testing import CliRunner

from lanenet.cli.app import app
from lanenet.cli.shared.standing import look_around
from lanenet.data.drives import find_format
from lanenet.viewers.mcap_file import McapFile


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder, which is the working folder."""
    folder = tmp_path / "here"
    folder.mkdir()
    monkeypatch.chdir(folder)
    return folder


def said() -> str:
    result = CliRunner().invoke(app, [])
    assert result.exit_code == 0, result.output
    return result.stdout


def add_map(folder: Path, drive: Path, name: str = "map", **content: str) -> None:
    folder.mkdir(parents=True)
    (folder / f"{name}.yaml").write_text(yaml.safe_dump({"drive": str(drive.resolve()), **content}))


def test_it_goes_with_the_user_from_drive_to_network(here: Path) -> None:
    assert "copy a drive here" in said() and "lanenet --help" in said()
    (here / "mycar" / "data").mkdir(parents=True)
    tub = write_tub(here / "mycar" / "data" / "tub_1", [record(0)])
    assert "drives       mycar/data/tub_1" in said()
    assert "next: lanenet train mycar/data/tub_1 --lane-width CM --wheelbase CM --name tub_1" in said()
    add_map(here / "runs" / "tub_1", tub, verdict="good")
    assert "maps         runs/tub_1" in said()
    assert "next: lanenet train runs/tub_1 --name tub_1" in said()
    for ending in ("parquet", "json"):
        (here / "runs" / f"tub_1.{ending}").touch()
    # One of simulated drives has not learned from it.
    add_map(here / "checkpoints" / "general", tub, "checkpoint")
    assert "label sets   runs/tub_1.parquet" in said() and "checkpoints  checkpoints/general" in said()
    assert "next: lanenet train runs/tub_1 --name tub_1" in said()
    add_map(here / "checkpoints" / "tub_1", tub, "checkpoint")
    run = {"data": {"drives": [{"path": str(here / "runs" / "tub_1")}]}}
    (here / "checkpoints" / "tub_1" / "run.yaml").write_text(yaml.safe_dump(run))
    # There is a network: what comes next is the car.
    own = "checkpoints/tub_1/car.yaml"
    copied = f"cp configs/car/picamera_pca9685.yaml {own}"
    assert f"next, for the car: {copied}, set its pulses, then lanenet doctor --config {own}" in said()
    (here / own).touch()
    assert f"next: lanenet doctor --config {own}" in said()
    (here / "car.yaml").touch()
    assert "next: lanenet drive car.yaml --dry-run" in said()
    (here / "runs" / "tub_1" / "map.yaml").unlink()
    run["data"]["drives"][0]["path"] = str(tub)
    (here / "checkpoints" / "tub_1" / "run.yaml").write_text(yaml.safe_dump(run))
    assert "next: lanenet drive car.yaml --dry-run" in said()


@pytest.mark.parametrize("run", ["runs/mycar", "run", "."])
def test_the_map_that_a_training_made_is_listed_once(here: Path, run: str) -> None:
    drive = write_drive(here / "lap", 2)
    add_map(here / run / "drives" / "maps" / "lap-1234", drive, verdict="good")
    made = Path(run) / "drives" / "maps" / "lap-1234"
    assert list(look_around(Path()).maps) == [made] and f"maps         {made}\n" in said()
    assert f"next: lanenet train {made} --name lap-1234" in said()


@pytest.mark.parametrize("name", ["map", "refused"])
def test_a_drive_without_a_good_map_is_not_mapped_once_more(here: Path, name: str) -> None:
    add_map(here / "runs" / "lap", write_drive(here / "lap", 2), name, verdict="reject")
    assert "no good map  runs/lap" in said() and "in runs/lap/report.html" in said()
    # The next drive is.
    write_drive(here / "lap2", 2)
    assert "next: lanenet train lap2 " in said()


def test_what_is_damaged_hidden_or_part_of_something_is_no_drive(here: Path) -> None:
    write_drive(here / "lap" / "images" / "inner", 2)
    write_drive(here / ".cache" / "lap", 2)
    (here / "lap" / "frames.csv").touch()
    (here / "lanes.parquet").touch()
    (here / "runs").mkdir()
    for folder in ("runs", "."):
        (here / folder / "clip.mp4").touch()
    McapFile("seen.mcap").close()
    (here / "broken").mkdir()
    (here / "broken" / "map.yaml").write_text("[")
    found = look_around(Path())
    # An annotated video of a run is no drive.
    assert find_format(Path("seen.mcap")) and found.drives == (Path("clip.mp4"), Path("lap"))
    assert list(found.refused) == [Path("broken")] and not found.maps and not found.label_sets


def test_a_clone_holds_no_drive_before_one_is_copied_into_it() -> None:
    repo = Path(__file__).resolve().parents[3]
    shipped = [path for name in ("checkpoints", "configs", "docs") for path in (repo / name).rglob("*")]
    assert [path for path in shipped if path.is_dir() and find_format(path) is not None] == []
    # Those of the tests lie deeper than anybody looks for them.
    assert not [path for path in look_around(repo).drives if (repo / "tests") in path.parents]


def test_help_has_its_verbs_in_groups() -> None:
    text = CliRunner().invoke(app, ["--help"], env={"COLUMNS": "120"}).stdout
    at = [
        text.index(word)
        for word in ("Your own drive", " map ", "On the car", " stop ", "Research", " judge ")
    ]
    assert at == sorted(at)
