"""Maps of several drives of one track -> one map frame and one set of lines, a map for each drive."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from datagen.assemble import assemble
from datagen.check import check_map
from datagen.compile_ahead import compile_ahead
from datagen.lanes.find import MappedSegment, find_lane
from datagen.lanes.scale import LaneWidth, fitted_width
from datagen.pipeline import write_checked
from datagen.quality.figures import Report
from datagen.slam.segment import StageProgress
from datagen.tracks.cameras import CameraDifference, DriveCamera, difference, same_lens
from datagen.tracks.pictures import draw_joined
from datagen.tracks.recognise import Recognised, recognise
from datagen.tracks.relaid import RelaidPlace, masked_lines, relaid_places
from datagen.tracks.shape import Similarity, TrackShape, read_shape, sample_line, thinned
from datagen.tracks.together import Together, solve_together
from datagen.tracks.visit import Visit, read_visit
from lanenet.data.files import atomic_folder, check_replaceable, write_json
from lanenet.data.maps.folder import check_map_files
from lanenet.data.maps.joined import FORMAT, JoinedDrive, JoinedMeta, maps_in, write_joined
from lanenet.data.maps.line import LaneLine
from lanenet.data.maps.mapped_drive import MappedDrive
from lanenet.errors import LanenetError, MapFormatError, TrackingLostError
from lanenet.outputs import lock_output
from lanenet.reading import read_json

_REPORT_FORMAT = "lanenet-join-report/1"


@dataclass(frozen=True)
class Placed:
    """A map and how it lies on the first one.

    Attributes:
        visit: The map with its drive.
        move: Moves it onto the first one.
        opposite: Whether its drive went in the opposite direction of the first.
        sentence: Why it is of the same track; "" for the first.
    """

    visit: Visit
    move: Similarity
    opposite: bool = False
    sentence: str = ""


def join_maps(folders: Sequence[Path], out: Path, progress: StageProgress | None = None) -> Report:
    """Join maps of one track.

    Args:
        folders: Maps of different drives; the frame of the first one stays.
        out: Folder to write.
        progress: Called with (stage, done, total).

    Raises:
        LanenetError: If a map is not of the first one's track, if that is not certain, or if a map or its
            drive cannot be read.
        TrackingLostError: If the drives together show no lane.
    """
    _check_distinct(folders)
    with lock_output(out):
        check_replaceable(out, "joined")
        tell = progress or (lambda stage, done, total: None)
        placed, refused = place_visits([read_visit(folder) for folder in folders], tell)
        if refused:
            why = "; ".join(f"{folders[number]} {reason}" for number, reason in refused.items())
            raise LanenetError(f"not joined to {folders[0]}: {why}")
        return _join(_names([placed[number] for number in range(len(folders))]), out, tell)


def join_fitting(visits: Mapping[str, Visit], out: Path, progress: StageProgress | None = None) -> Report:
    """Join the most maps that are of one track, and leave the others out.

    Args:
        visits: Maps of different drives, by the names that theirs get in the joined folder.
        out: Folder to write.
        progress: Called with (stage, done, total).

    Returns:
        As :func:`join_maps`; the figures also have why maps were left out, ``left_out``, by their names.

    Raises:
        TrackingLostError: If no two are certainly of one track, or the drives together show no lane.
    """
    with lock_output(out):
        check_replaceable(out, "joined")
        tell = progress or (lambda stage, done, total: None)
        best, left_out = _largest_track(visits, tell)
        if len(best) < 2:
            why = "; ".join(f"{name} {reason}" for name, reason in left_out.items())
            raise TrackingLostError(f"no two of {len(visits)} maps are joined: {why}")
        report = _join(best, out, tell)
        return replace(report, figures={**report.figures, "left_out": left_out})


def _largest_track(
    visits: Mapping[str, Visit], tell: StageProgress
) -> tuple[dict[str, Placed], dict[str, str]]:
    """Find the most maps that lie on one another, and why the others do not lie on them."""
    best: dict[str, Placed] = {}
    reasons, left = dict[str, str](), list(visits)
    earlier: list[tuple[list[str], dict[str, str]]] = []
    while len(left) > len(best):
        found, refused = place_visits([visits[name] for name in left], tell)
        placed = {left[number]: one for number, one in found.items()}
        why = {left[number]: reason for number, reason in refused.items()}
        earlier.append((list(placed), why))
        if len(placed) > len(best):
            best, reasons = placed, why
        left = list(why)
    for names, why in earlier:
        # Maps that were placed before the best ones were refused there, each for the same reason.
        first = next((name for name in best if name in why), None)
        reasons |= {name: why[first] for name in names if first is not None and name not in best}
    return best, {name: reasons[name] for name in visits if name not in best}


def _join(placed: dict[str, Placed], out: Path, tell: StageProgress) -> Report:
    """Adjust maps together that lie on the first one, and write the folder."""
    compile_ahead()
    moved = [one.visit.moved(one.move) for one in placed.values()]
    cameras = _camera_differences([visit.found_camera for visit in moved])
    shared = bool(cameras) and all(one.agree for one in cameras.values())
    rng = np.random.default_rng(moved[0].prepared.settings.seed)
    tell("adjust", 0, 1)
    together = solve_together(moved, shared, rng)
    tell("lines and checks", 0, len(placed) + 1)
    return _write(placed, together, shared, cameras, out, tell)


def place_visits(visits: Sequence[Visit], tell: StageProgress) -> tuple[dict[int, Placed], dict[int, str]]:
    """Find how each map lies on the first one, over others where it shares too little with that.

    Returns:
        The maps of the first one's track, by their places among all, and why the others are none.
    """
    shapes = [read_shape(one.folder) for one in visits]
    placed: dict[int, Placed] = {0: Placed(visits[0], Similarity())}
    refused: dict[int, Recognised] = {}
    while True:
        tell("recognise", len(placed), len(visits))
        before = len(placed)
        for number in range(1, len(visits)):
            for known in [k for k in placed if number not in placed]:
                drives = visits[number].mapped, visits[known].mapped
                found = recognise(shapes[number], shapes[known], drives)
                if found.answer == "same" and found.alignment is not None:
                    base = placed[known]
                    placed[number] = Placed(
                        visits[number],
                        found.alignment.move.then(base.move),
                        found.alignment.opposite != base.opposite,
                        found.sentence,
                    )
                    break
                refused.setdefault(number, found)
        if len(placed) == before:
            break
    missing = [number for number in range(len(visits)) if number not in placed]
    why = {n: f"{_NOT_JOINED[refused[n].answer]}: {refused[n].sentence}" for n in missing}
    return {number: placed[number] for number in sorted(placed)}, why


_NOT_JOINED = {
    "different": "is of another track",
    "ambiguous": "fits in more than one way",
    "undetermined": "may be of this track, but where it lies on it is open",
    "same": "is of this track",
}


def _check_distinct(folders: Sequence[Path]) -> None:
    if len(folders) < 2:
        raise LanenetError(f"{len(folders)} map given, expected at least two")
    resolved = [folder.resolve() for folder in folders]
    twice = next((folder for folder in resolved if resolved.count(folder) > 1), None)
    if twice is not None:
        raise LanenetError(f"{twice}: is given twice")
    joined = next((folder for folder in folders if maps_in(folder) != [folder]), None)
    if joined is not None:
        inside = " ".join(str(one) for one in maps_in(joined))
        raise LanenetError(f"{joined}: is joined already; give the maps that it was made from: {inside}")


def _camera_differences(drives: Sequence[DriveCamera]) -> dict[str, CameraDifference]:
    """How the cameras of each pair of drives differ; none where they are of different kinds."""
    if not same_lens(drives):
        return {}
    return {f"{a.name} and {b.name}": difference(a, b) for a, b in combinations(drives, 2)}


def _names(placed: Sequence[Placed]) -> dict[str, Placed]:
    """Name the drives' maps after their drives; drives of one name get numbers."""
    names: dict[str, Placed] = {}
    for one in placed:
        name, count = one.visit.name, 2
        while name in names:
            name, count = f"{one.visit.name}-{count}", count + 1
        names[name] = one
    return names


def _write(
    placed: dict[str, Placed],
    together: Together,
    shared: bool,
    cameras: dict[str, CameraDifference],
    out: Path,
    tell: StageProgress,
) -> Report:
    """Find the lines of all drives together, check them in each, and write the folder."""
    first = together.visits[0].prepared
    whole = _lane_of_all(together)
    lane = fitted_width(whole.lines, whole.lane, whole.s_frames_cm)
    places = _relaid(placed, together, whole)
    kept = masked_lines(whole.lines, places, lane.width_cm)
    withheld = [line.contradicted_cm for line in kept]
    factor, drives, verdicts, members = 1.0, [], {}, []
    with atomic_folder(out, "joined") as folder:
        for number, (name, one) in enumerate(placed.items()):
            visit = together.visits[number]
            mapped = _own_frames(together, whole, number)
            figures = _calibration(one.visit, visit)
            request = replace(visit.prepared.request, lane_width_cm=first.request.lane_width_cm)
            # The first map sets the scale of all.
            known = None if first.camera is None else visit.camera
            prepared = replace(visit.prepared, request=request, camera=known)
            assembled = assemble(prepared, visit.camera, visit.sigma, [mapped], lane)
            factor = assembled.factor
            checked = check_map(prepared, assembled, figures)
            checked = replace(checked, mapped=_withheld(checked.mapped, withheld, factor))
            notes = [f"joined with {_others(placed, name)}", *checked.notes]
            report = {
                "drive": str(request.drive_path),
                "frames": len(prepared.drive),
                "segments": 1,
                **figures,
                **checked.figures,
                "notes": notes,
            }
            own = folder / name
            own.mkdir()
            how = "adjusted together with those of other drives of the track" if shared else "as it was"
            write_checked(own, out / name, prepared, assembled, checked, report, how, pictures=True)
            check_map_files(own)
            verdicts[name] = checked.verdict
            members.append((name, assembled, checked.mapped.drive_map))
            drives.append(_joined_drive(name, one))
            tell("lines and checks", number + 1, len(placed) + 1)
        scaled = [_scaled(place, factor) for place in places]
        write_joined(folder, JoinedMeta(format=FORMAT, shared_camera=shared, drives=tuple(drives)))
        draw_joined(folder / "map.png", members, scaled)
        figures = _figures(placed, cameras, shared, scaled, lane, factor)
        figures["verdicts"] = {name: asdict(verdict) for name, verdict in verdicts.items()}
        write_json(folder / "join.json", figures)
    tell("lines and checks", len(placed) + 1, len(placed) + 1)
    lines = [f"{name}: {one.sentence}" for name, one in placed.items() if one.sentence]
    lines += [f"cameras of {pair}: {one.text}" for pair, one in cameras.items()]
    lines.append(
        "one camera for all drives, adjusted together" if shared else "each drive keeps its own camera"
    )
    lines += [f"laid anew: {place.text}" for place in scaled]
    lines += [f"{name}: verdict {verdict.grade}: {verdict.sentence}" for name, verdict in verdicts.items()]
    return Report(tuple(lines), figures)


def _lane_of_all(together: Together) -> MappedSegment:
    """Find the lines that all drives show."""
    first = together.visits[0].prepared
    held_out = np.concatenate([one.prepared.held_out for one in together.visits])
    known_cm = together.visits[0].mapped.drive_map.meta.mapped_lane_cm if first.camera is not None else None
    return find_lane(together.solved, known_cm, held_out, first.settings.trace, first.settings.fit)


def _own_frames(together: Together, whole: MappedSegment, number: int) -> MappedSegment:
    """Return what the joined map has of one drive."""
    rows = np.flatnonzero(together.of == number)
    laps = whole.laps[rows]
    return replace(
        whole,
        solved=together.solved_of(number),
        s_frames_cm=whole.s_frames_cm[rows],
        laps=laps - laps.min(),
    )


def _relaid(placed: dict[str, Placed], together: Together, whole: MappedSegment) -> list[RelaidPlace]:
    """Fit each drive's lines to its own edges, and find where they contradict each other."""
    shapes = []
    for number, (name, visit) in enumerate(zip(placed, together.visits, strict=True)):
        solved, settings = together.solved_of(number), visit.prepared.settings
        try:
            own = find_lane(solved, None, visit.prepared.held_out, settings.trace, settings.fit, whole.dark)
        except TrackingLostError:
            continue
        lines = tuple(sample_line(line, own.s_frames_cm) for line in own.lines)
        empty = np.empty((0, 2))
        shapes.append(TrackShape(name, whole.lane.lane_cm, lines, thinned(solved.poses), empty, empty))
    return relaid_places(shapes)


def _withheld(mapped: MappedDrive, withheld: list[np.ndarray], factor: float) -> MappedDrive:
    """Withhold the places that were laid anew beside those that the check found."""
    drive_map = mapped.drive_map
    lines: list[LaneLine] = [
        replace(line, contradicted_cm=np.concatenate([line.contradicted_cm, factor * sections]))
        for line, sections in zip(drive_map.lines[0], withheld, strict=True)
    ]
    return replace(mapped, drive_map=replace(drive_map, lines={0: lines}))


def _calibration(before: Visit, after: Visit) -> dict[str, Any]:
    """Figures of the camera as the map had them, with the sigmas of the joint adjustment."""
    figures = read_json(before.folder / "report.json", MapFormatError).get("calibration")
    return {} if not figures else {"calibration": {**figures, "sigma": after.sigma}}


def _joined_drive(name: str, one: Placed) -> JoinedDrive:
    return JoinedDrive(
        map=name, made_from=str(one.visit.folder.resolve()), opposite=one.opposite, **asdict(one.move)
    )


def _others(placed: dict[str, Placed], name: str) -> str:
    return ", ".join(other for other in placed if other != name)


def _scaled(place: RelaidPlace, factor: float) -> RelaidPlace:
    x, y = place.at_cm
    return replace(
        place,
        at_cm=(factor * x, factor * y),
        points_cm=factor * place.points_cm,
        length_cm=factor * place.length_cm,
        apart_cm=None if place.apart_cm is None else factor * place.apart_cm,
    )


def _figures(
    placed: dict[str, Placed],
    cameras: dict[str, CameraDifference],
    shared: bool,
    places: Sequence[RelaidPlace],
    lane: LaneWidth,
    factor: float,
) -> dict[str, Any]:
    """Collect the figures of the join."""
    return {
        "format": _REPORT_FORMAT,
        "drives": {
            name: {"move": asdict(one.move), "opposite": one.opposite, "agreement": one.sentence}
            for name, one in placed.items()
        },
        "cameras": {pair: asdict(one) for pair, one in cameras.items()},
        "shared_camera": shared,
        "lane_cm": factor * lane.width_cm,
        "relaid": [
            {
                "text": p.text,
                "drives": list(p.drives),
                "at_cm": list(p.at_cm),
                "length_cm": p.length_cm,
                "apart_cm": p.apart_cm,
            }
            for p in places
        ],
    }
