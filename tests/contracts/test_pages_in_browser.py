"""The report pages on a phone, in light and dark: pictures there, with captions, nothing wider than it.

``make screenshots`` keeps the pictures, to be looked at.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from pathlib import Path

import cv2
import pytest
from chromium import PHONE_PX, Seen, see, take_screenshot
from fleet_work import HereEngine

from datagen.fleet.checksums import with_checksums
from datagen.fleet.page import FLEET_PAGE_NAME
from datagen.fleet.run import label_all
from datagen.fleet.storage import Storage
from datagen.fleet.task import FleetDrive, FleetSettings
from datagen.judge.contest import judge
from datagen.judge.page import write_page
from datagen.judge.run import TRUTH, Entrant
from datagen.judge.settings import JudgeSettings
from datagen.labels.truth import truth_labels
from datagen.pipeline import MapRequest, map_drive
from datagen.settings import MapSettings
from datagen.world.simulate import simulate_drive
from datagen.world.world import SimulationSettings
from lanenet.cli.research.judge import NamedDetector
from lanenet.errors import CalibrationError
from lanenet.evaluation.answers import Compared
from lanenet.evaluation.comparison import evaluate
from lanenet.evaluation.model_page import model_page
from lanenet.evaluation.sources import open_source
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.perception.network.model_file import read_model_meta

SMALL = Path(__file__).parents[2] / "checkpoints" / "small" / "model.onnx"
CAMERA = {"width": 160, "height": 120, "field_of_view_rad": math.radians(120.0), "height_cm": 17.0}


def _drive(folder: Path, frames: int) -> Path:
    track = {"left": {}, "right": {}, "interruptions_per_m": 0.0}
    settings = {"seed": 1, "frames": frames, "camera": CAMERA, "track": track}
    return simulate_drive(SimulationSettings.model_validate(settings), folder / "drive")


def _of_map(folder: Path) -> Path:
    map_drive(MapRequest(_drive(folder, 80), 40.0), MapSettings(find_bumper=False), folder / "map")
    return folder / "map" / "report.html"


def _of_refusal(folder: Path) -> Path:
    with pytest.raises(CalibrationError, match="20 cm apart"):
        map_drive(MapRequest(_drive(folder, 80), 20.0), MapSettings(find_bumper=False), folder / "map")
    return folder / "map" / "report.html"


def _of_model(folder: Path) -> Path:
    meta = read_model_meta(SMALL)
    drive = open_source(_drive(folder, 20), BirdseyeWindow(), meta.perception, truth_labels)
    compared = Compared(("network", "painter"), {"network": SMALL}, None, True)
    comparison, seen = evaluate([drive], compared, [])
    (folder / "model.html").write_text(
        model_page("How good small is", comparison, seen, "on 20 frames"), encoding="utf-8"
    )
    return folder / "model.html"


def _of_judge(folder: Path) -> Path:
    simulation = {"camera": {"width": 48, "height": 36}, "track": {"length_cm": 320.0}, "rate_hz": 10.0}
    settings = JudgeSettings.model_validate(
        {"tracks": ("open",), "count": 2, "laps": 1, "simulation": simulation}
    )
    entrants = [Entrant(TRUTH), Entrant("painter", NamedDetector("painter"), "p")]
    return write_page(folder, settings, entrants, judge(settings, entrants, folder))


def _of_fleet(folder: Path) -> Path:
    drive, storage = _drive(folder, 80), Storage(str(folder / "fleet"))
    other = _drive(folder / "other", 79)
    drives = [FleetDrive("good", str(drive), "", 40.0), FleetDrive("narrow", str(other), "", 20.0)]
    label_all(
        with_checksums(drives, storage),
        FleetSettings(map=MapSettings(find_bumper=False)),
        storage,
        HereEngine(),
    )
    return folder / "fleet" / FLEET_PAGE_NAME


#: By page: what makes it, its first words, and how many pictures it has at least.
PAGES: dict[str, tuple[Callable[[Path], Path], str, int]] = {
    "model": (_of_model, "On 20 frames it lies", 4),
    "judge": (_of_judge, "Painter stays in its lane on", 2),
    "map": (_of_map, "GOOD", 10),
    "refusal": (_of_refusal, "REFUSED", 17),
    "fleet": (_of_fleet, "1 of 2 drives have labels", 1),
}


@pytest.fixture(
    scope="module",
    params=[
        "model",
        "judge",
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("map", "refusal", "fleet")),
    ],
)
def page(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    return request.param, PAGES[request.param][0](tmp_path_factory.mktemp(request.param))


@pytest.fixture
def screenshots(tmp_path: Path) -> Path:
    folder = Path(os.environ.get("LANENET_SCREENSHOTS", tmp_path))
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def check_fits(seen: Seen, least_figures: int) -> None:
    assert seen.width_px == PHONE_PX
    assert seen.folded_px <= PHONE_PX and seen.opened_px <= PHONE_PX
    assert len(seen.figures) >= least_figures
    for figure in seen.figures:
        assert figure.natural_px > 0 and len(figure.caption) > 5, figure
        assert figure.left_px >= 0.0 and figure.right_px <= PHONE_PX, figure
    assert seen.fetched == ()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_phone_shows_the_whole_page(page: tuple[str, Path], scheme: str, tmp_path: Path, screenshots: Path):
    name, file = page
    dark = scheme == "dark"
    seen = see(file, tmp_path, dark)
    check_fits(seen, PAGES[name][2])
    assert seen.first.startswith(PAGES[name][1])
    # Letters stand out, in the scheme that was asked for.
    assert (seen.paper < 60 and seen.ink > 200) if dark else (seen.paper > 240 and seen.ink < 60)
    png = screenshots / f"{name}-{scheme}.png"
    take_screenshot(file, png, tmp_path, dark, seen.height_px)
    picture = cv2.imread(str(png))
    assert picture is not None and picture.shape[:2] == (seen.height_px, PHONE_PX)
    # The last row shows the page's own colour: nothing is cut off or left over.
    assert abs(int(picture[-1].mean()) - seen.paper) < 5


def test_the_check_sees_what_does_not_fit(tmp_path: Path):
    file = tmp_path / "wide.html"
    picture = '<figure><img src="{}" alt=""><figcaption>a picture</figcaption></figure>'
    style = "<style>body{color:rgb(1,1,1);background:rgb(255,255,255)}</style>"
    file.write_text(f"{style}<h1>Wide</h1><p style='width:600px'>wide</p>{picture.format('missing.png')}")
    seen = see(file, tmp_path, dark=False)
    assert seen.folded_px > PHONE_PX and seen.figures[0].natural_px == 0
    with pytest.raises(AssertionError):
        check_fits(seen, 1)
