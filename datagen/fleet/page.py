"""The page of a run: its drives by verdict with their maps, why others have none, and what the work took."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from math import fsum
from typing import Any

import cv2
import numpy as np

from datagen.fleet.result import DUPLICATE, FAILED, LEFT, CarFound, FleetResult, Labelled
from datagen.fleet.storage import Storage
from datagen.fleet.task import MAPS, TRACKS
from datagen.fleet.work import REFUSED, REJECTED, THUMBNAIL_NAME
from lanenet.errors import counted
from lanenet.page import Picture, Row, bullets, details, gallery, note, page_of, section, subsection, table

FLEET_PAGE_NAME = "index.html"
#: In this order, and what each is called.
_VERDICTS = {
    "good": "good",
    "usable": "usable",
    REJECTED: "rejected",
    REFUSED: "refused",
    FAILED: "failed",
    LEFT: "left",
    DUPLICATE: "given twice",
}
_NOT_COUNTED = " Cameras of cars, the maps that they were found from, and joined maps are not counted."
#: Maps that are shown of each verdict, and their longer side, [px]; lines of a list. Chosen: a map takes
#: about 10 kB, so a page has 6 MB at most.
_MOST_MAPS, _MAP_PX, _MOST_LINES = 150, 240, 200


def write_page(result: FleetResult, storage: Storage) -> None:
    """Write the page of a run beside its results."""
    keys = [drive.map_key for drives in _shown(result).values() for drive in drives]
    tracks = [track.key for track in result.tracks[:_MOST_MAPS] if track.joined]
    thumbnails = storage.read_all(MAPS, keys, THUMBNAIL_NAME) | storage.read_all(
        TRACKS, tracks, THUMBNAIL_NAME
    )
    page = fleet_page(result, thumbnails)
    storage.write(FLEET_PAGE_NAME, page.encode())


def fleet_page(result: FleetResult, thumbnails: Mapping[str, bytes]) -> str:
    """Return the page as HTML.

    Args:
        result: What became of the drives.
        thumbnails: JPEG by the key of a map or of joined ones; of those that lack it, the page shows none.
    """
    labelled = result.with_labels
    hours = _text_of_time(fsum(map(_driven_s, labelled)))
    frames = sum(int(drive.labelled["frames_labelled"]) for drive in labelled if drive.labelled)
    sentence = (
        f"{len(labelled)} of {counted(len(result.drives), 'drive')} have labels: {hours} of driving, "
        f"{counted(frames, 'labelled frame').replace(str(frames), f'{frames:,}')}"
    )
    body = [
        table(_verdict_rows(result)),
        note(f"{result.disk_full}.") if result.disk_full else "",
        *_reasons(result),
        *_cars(result.cars),
        *_tracks(result, thumbnails),
        section("Maps"),
        *(
            part
            for verdict, drives in _shown(result).items()
            for part in _maps(result, verdict, drives, thumbnails)
        ),
        section("What it took"),
        table(_cost_rows(result.drives)),
        note(
            "Of all results that these drives have, whichever run made them; one thread each. Memory is the "
            "most that a process had in RAM. Storage counts maps and labels with their pictures."
            + (_NOT_COUNTED if result.cars or result.tracks else "")
        ),
        details("By machine", table(_machine_rows(result.drives))),
    ]
    return page_of("Many drives", "", sentence, body)


def _shown(result: FleetResult) -> dict[str, list[Labelled]]:
    """Return the drives whose maps are on the page, by verdict: evenly chosen where there are many."""
    shown = {}
    for verdict in ("good", "usable", REJECTED):
        drives = result.of(verdict)
        places = np.unique(np.linspace(0, len(drives) - 1, min(len(drives), _MOST_MAPS)).astype(int))
        shown[verdict] = [drives[k] for k in places]
    return shown


def _verdict_rows(result: FleetResult) -> list[Row]:
    rows: list[Row] = [("", "drives", "driven", "frames", "with labels")]
    for verdict, name in _VERDICTS.items():
        if drives := result.of(verdict):
            frames = sum(int(drive.mapped["frames"]) for drive in drives if drive.mapped)
            labels = sum(int(drive.labelled["frames_labelled"]) for drive in drives if drive.labelled)
            driven = _text_of_time(fsum(map(_driven_s, drives)))
            rows.append((name, str(len(drives)), driven, f"{frames:,}", f"{labels:,}"))
    return rows


def _reasons(result: FleetResult) -> list[str]:
    """Count why drives have no labels; numbers in a reason do not make it another one."""
    without = [drive for drive in result.drives if drive.reason]
    if not without:
        return []
    alike: dict[tuple[str, str], list[Labelled]] = defaultdict(list)
    for drive in without:
        alike[drive.verdict, re.sub(r"\d+(\.\d+)?", "0", _own_names_out(drive))].append(drive)
    rows: list[Row] = [("", "reason, as of one of them", "drives")]
    for (verdict, _), drives in sorted(alike.items(), key=lambda item: -len(item[1]))[:_MOST_LINES]:
        rows.append((_VERDICTS[verdict], drives[0].reason, str(len(drives))))
    lines = [f"{drive.drive.name}: {drive.reason}" for drive in without]
    more = len(lines) - _MOST_LINES
    return [
        section("Why drives have no labels"),
        table(rows, texts=2),
        details(
            "Each of them",
            bullets(lines[:_MOST_LINES]),
            note(f"And {more} more, in drives.json.") if more > 0 else "",
        ),
    ]


def _cars(cars: Sequence[CarFound]) -> list[str]:
    """Show the camera of each car, and which drives keep another one."""
    if not cars:
        return []
    rows: list[Row] = [("car", "drives", "with its camera", "found from", "focal length", "pitch", "height")]
    lines = []
    for car in cars[:_MOST_LINES]:
        if car.camera is not None:
            focal_px, mounting = float(car.camera.K[0, 0]), car.camera.mounting
            rows.append(
                (
                    car.name,
                    str(len(car.drives)),
                    str(len(car.drives) - len(car.own)),
                    f"{len(car.from_drives)}",
                    f"{focal_px:.1f} +- {focal_px * car.sigma.get('focal', 0.0):.1f} px",
                    f"{np.rad2deg(mounting.pitch_down_rad):.1f} degrees",
                    f"{mounting.height_cm:.1f} cm",
                )
            )
        else:
            rows.append((car.name, str(len(car.drives)), "0", "-", "-", "-", "-"))
            lines.append(f"{car.name}: no camera for all: {car.reason}")
        lines += [f"{name} of {car.name} keeps its own camera: {why}" for name, why in car.own.items()]
    return [section("Cars"), table(rows), bullets(lines[:_MOST_LINES]) if lines else ""]


def _tracks(result: FleetResult, thumbnails: Mapping[str, bytes]) -> list[str]:
    """Show the joined map of each track, what was not joined, and where lines were laid anew."""
    if not (result.tracks or result.uncompared):
        return []
    rows: list[Row] = [("track", "drives with maps", "joined", "lane", "laid anew")]
    lines, pictures = [f"could not be compared: {text}" for text in result.uncompared], []
    for track in result.tracks[:_MOST_LINES]:
        lane = "-" if track.lane_cm is None else f"{track.lane_cm:.1f} cm"
        counts = (str(track.count), str(len(track.joined)))
        rows.append((track.name, *counts, lane, str(len(track.relaid))))
        if track.reason:
            lines.append(f"{track.name}: {track.reason}")
        lines += [f"{name} is not joined to {track.name}: {why}" for name, why in track.left_out.items()]
        lines += [f"{track.name}: laid anew: {text}" for text in track.relaid]
        if track.key in thumbnails:
            caption = f"{track.name}: {', '.join(track.joined)}"
            pictures.append(Picture(_decoded(thumbnails[track.key]), caption))
    return [
        section("Tracks"),
        table(rows),
        bullets(lines[:_MOST_LINES]) if lines else "",
        gallery(pictures) if pictures else "",
    ]


def _own_names_out(drive: Labelled) -> str:
    return drive.reason.replace(drive.drive.source, "").replace(drive.drive.name, "")


def _maps(
    result: FleetResult, verdict: str, drives: Sequence[Labelled], thumbnails: Mapping[str, bytes]
) -> list[str]:
    pictures = [
        Picture(_decoded(thumbnails[drive.map_key]), _caption(drive))
        for drive in drives
        if drive.map_key in thumbnails
    ]
    if not pictures:
        return []
    total = len(result.of(verdict))
    some = note(f"{len(pictures)} of {total}, evenly chosen.") if len(pictures) < total else ""
    return [subsection(f"{_VERDICTS[verdict].capitalize()} ({total})"), some, gallery(pictures)]


def _decoded(jpeg: bytes) -> Any:
    image = np.asarray(cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR))
    factor = min(1.0, _MAP_PX / max(image.shape))
    return cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)


def _caption(drive: Labelled) -> str:
    mapped = drive.mapped or {}
    said = f"{drive.drive.name}: {mapped.get('frames', 0)} frames, {_text_of_time(_driven_s(drive))}"
    if drive.labelled and "residual_cm" in drive.labelled:
        said += f", residual {drive.labelled['residual_cm']:.1f} cm"
    return said


def _cost_rows(drives: Iterable[Labelled]) -> list[Row]:
    of_map = [drive.mapped for drive in drives if drive.mapped]
    of_labels = [drive.labelled for drive in drives if drive.labelled]
    driven_s = fsum(marker["driven_s"] for marker in of_map)
    columns: list[Row] = [
        ("", "results", "time", "processor time", "the same, per hour driven", "most memory", "storage")
    ]
    for name, markers in (("maps", of_map), ("labels", of_labels), ("together", of_map + of_labels)):
        wall_s, cpu_s = (fsum(marker["took"][key] for marker in markers) for key in ("wall_s", "cpu_s"))
        most = max((int(marker["took"]["peak_bytes"]) for marker in markers), default=0)
        stored = sum(int(marker["bytes"]) for marker in markers)
        rate = _text_of_time(3600.0 * cpu_s / driven_s) if driven_s else "-"
        times = (_text_of_time(wall_s), _text_of_time(cpu_s), rate)
        columns.append((name, str(len(markers)), *times, f"{most / 1e6:,.0f} MB", f"{stored / 1e6:,.1f} MB"))
    return list(zip(*columns, strict=True))


def _machine_rows(drives: Iterable[Labelled]) -> list[Row]:
    results, cpu_s = Counter[str](), defaultdict[str, float](float)
    for drive in drives:
        for marker in filter(None, (drive.mapped, drive.labelled)):
            results[marker["made"]["on"]] += 1
            cpu_s[marker["made"]["on"]] += marker["took"]["cpu_s"]
    rows = [
        (name, str(count), _text_of_time(cpu_s[name])) for name, count in results.most_common(_MOST_LINES)
    ]
    return [("", "results", "processor"), *rows]


def _driven_s(drive: Labelled) -> float:
    return float(drive.mapped["driven_s"]) if drive.mapped else 0.0


def _text_of_time(time_s: float) -> str:
    if time_s < 100.0:
        return f"{time_s:.0f} s"
    return f"{time_s / 60.0:.0f} min" if time_s < 6000.0 else f"{time_s / 3600.0:,.1f} h"
