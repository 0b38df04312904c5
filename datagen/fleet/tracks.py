"""Drives of one track: named, or recognised by their maps; their maps are joined once all are mapped."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from datagen.fleet.engine import Engine, Task
from datagen.fleet.meter import Meter
from datagen.fleet.result import Labelled, TrackFound
from datagen.fleet.several import SeveralJob, finish, visits_of
from datagen.fleet.storage import Storage
from datagen.fleet.task import MAPS, TRACKS
from datagen.fleet.work import REFUSED, Outcome, attempted, mark, name_source, shrink_picture, version
from datagen.made import key_of
from datagen.tracks.join import join_fitting
from datagen.tracks.recognise import recognise
from datagen.tracks.shape import read_shape
from lanenet.data.files import json_text
from lanenet.data.maps.joined import read_joined, write_joined
from lanenet.errors import LanenetError, TrackingLostError

#: Which maps are of one track, beside the results.
ALIKE_NAME = "alike.json"
#: So many maps of a track are joined at most: all frames are adjusted together. Chosen: ten
#: minutes of driving or so.
_MOST_JOINED = 12
#: What the shapes of two maps take while they are compared, [bytes]. Chosen: ten times the edge points of a
#: map of 1200 frames.
_COMPARING = 1_000_000_000


@dataclass(frozen=True)
class AlikeJob:
    """What a worker needs to compare a map with others: their keys, the storage, and who wants it."""

    key: str
    others: tuple[str, ...]
    out: str
    made_by: str


def named_tracks(drives: Sequence[Labelled]) -> dict[str, list[Labelled]]:
    """Return the mapped drives of each track that has a name."""
    tracks: dict[str, list[Labelled]] = defaultdict(list)
    for drive in drives:
        if drive.drive.track and drive.has_labels:
            tracks[drive.drive.track].append(drive)
    return dict(tracks)


def recognised_tracks(
    drives: Sequence[Labelled], storage: Storage, engine: Engine
) -> tuple[dict[str, list[Labelled]], list[str]]:
    """Recognise drives of one track by their maps, where their track has no name.

    Pairs that were compared before are not compared again.

    Args:
        drives: All drives.
        storage: Where results are kept.
        engine: What spreads the work.

    Returns:
        The mapped drives of each track; and why maps could not be compared, which the next run does again.
    """
    mapped = [drive for drive in drives if drive.has_labels]
    known: dict[str, str] = storage.read_known(ALIKE_NAME)
    tasks, failed = list[Task](), list[str]()
    for place, drive in enumerate(mapped):
        before = [one for one in mapped[:place] if not (one.drive.track and drive.drive.track)]
        others = [one.map_key for one in before if _pair(drive.map_key, one.map_key) not in known]
        if others:
            job = AlikeJob(drive.map_key, tuple(others), storage.url, version())
            tasks.append(Task(f"track of {drive.drive.name}", job, _COMPARING))
    if tasks:
        with closing(engine.run(compare_maps, tasks)) as running:
            for end in running:
                task = tasks[end.number]
                if end.error:
                    failed.append(f"{task.name}: {end.error}")
                    continue
                answers, unreadable = end.result
                known |= {_pair(task.input.key, other): answer for other, answer in answers.items()}
                failed += unreadable
                storage.write(ALIKE_NAME, json_text(dict(sorted(known.items()))).encode())
    return _grouped(mapped, known), list(dict.fromkeys(failed))


def _pair(one: str, other: str) -> str:
    return " ".join(sorted((one, other)))


def compare_maps(job: AlikeJob) -> tuple[dict[str, str], list[str]]:
    """Say whether a map is of the track of others, by their keys; a function of a module.

    Returns:
        The answers; and why others could not be read.

    Raises:
        LanenetError: If the map cannot be read.
    """
    if job.made_by != version():
        raise LanenetError(f"found {version()}, the run needs {job.made_by}")
    storage = Storage(job.out)

    def shape(key: str) -> Any:
        with storage.fetched(MAPS, key) as folder:
            return read_shape(folder)

    own, answers, unreadable = shape(job.key), dict[str, str](), list[str]()
    for other in job.others:
        try:
            answers[other] = recognise(own, shape(other)).answer
        except (LanenetError, OSError) as error:
            unreadable.append(f"the map {other}: {error}")
    return answers, unreadable


def _grouped(mapped: Sequence[Labelled], known: Mapping[str, str]) -> dict[str, list[Labelled]]:
    """Put drives together that are of one track by name or by their maps; a track is called by its first."""
    groups: list[list[Labelled]] = []
    # Those with a name first: what is only alike finds whole tracks then, whatever the order of the drives.
    for drive in sorted(mapped, key=lambda one: not one.drive.track):
        alike = [
            group
            for group in groups
            if any(
                (drive.drive.track and one.drive.track == drive.drive.track)
                or known.get(_pair(drive.map_key, one.map_key)) == "same"
                for one in group
            )
        ]
        names = {one.drive.track for group in alike for one in group if one.drive.track}
        if len(names | {drive.drive.track} - {""}) > 1:
            # A drive that lies on tracks of different names decides nothing: it stays where its name says.
            own = drive.drive.track
            alike = [group for group in alike if own and own in {one.drive.track for one in group}]
        groups = [group for group in groups if group not in alike]
        groups.append([*(one for group in alike for one in group), drive])
    named = {}
    for group in groups:
        in_order = sorted(group, key=mapped.index)
        name = next(
            (one.drive.track for one in group if one.drive.track), f"track of {in_order[0].drive.name}"
        )
        named[name] = in_order
    return named


def join_tracks(
    tracks: Mapping[str, Sequence[Labelled]], storage: Storage, engine: Engine, refused_again: bool = False
) -> tuple[list[TrackFound], str]:
    """Join the maps of each track that has several, unless that was done before.

    Args:
        tracks: The drives of each track.
        storage: Where results are kept.
        engine: What spreads the work.
        refused_again: Join maps again that did not fit before.

    Returns:
        The tracks, and which disk was full.
    """
    jobs = [track_job(name, drives, storage) for name, drives in tracks.items() if len(drives) > 1]
    failed, disk_full = finish(jobs, TRACKS, join_drives, storage, engine, refused_again=refused_again)
    return [_found(job, len(tracks[job.name]), storage, failed.get(job.key, "")) for job in jobs], disk_full


def track_job(name: str, drives: Sequence[Labelled], storage: Storage) -> SeveralJob:
    """Choose the maps that are joined; their order, and so the frame of the track, is that of the drives."""
    # Keys are as good as drawn at random, and of the drives that a track gets later few change the choice.
    least = set(sorted(drive.map_key for drive in drives)[:_MOST_JOINED])
    chosen = tuple((drive.drive, drive.map_key) for drive in drives if drive.map_key in least)
    key = key_of(TRACKS, [(drive.name, map_key) for drive, map_key in chosen])
    return SeveralJob(name, chosen, storage.url, key, version())


def join_drives(job: SeveralJob) -> Outcome:
    """Join the maps of a track; a function of a module, since workers call it."""
    return attempted(job.made_by, lambda: _join(job))


def _join(job: SeveralJob) -> Outcome:
    storage, meter = Storage(job.out), Meter()
    marker: dict[str, Any] = {"track": job.name, "drives": [drive.name for drive, _ in job.drives]}
    with visits_of(job, storage) as visits, storage.new(TRACKS, job.key) as folder:
        try:
            report = join_fitting(visits, folder)
        except TrackingLostError as error:
            # An answer, which stays; whatever else goes wrong is tried again.
            mark(folder, {**marker, "verdict": REFUSED, "reason": str(error)}, meter)
            return Outcome(REFUSED, str(error))
        _name_places(folder, job)
        shrink_picture(folder)
        figures = report.figures
        facts = {name: figures[name] for name in ("left_out", "lane_cm", "shared_camera", "relaid")}
        joined = list(figures["drives"])
        mark(folder, {**marker, "verdict": "joined", "reason": "", "joined": joined, **facts}, meter)
    return Outcome("joined")


def _name_places(folder: Path, job: SeveralJob) -> None:
    """Let joined maps name their drives and maps by the places where they lie for all machines."""
    keys = {drive.name: key for drive, key in job.drives}
    for drive, _ in job.drives:
        if (folder / drive.name).is_dir():
            name_source(folder / drive.name / "map.yaml", drive.source)
    meta = read_joined(folder)
    drives = tuple(
        one.model_copy(update={"made_from": f"{job.out.rstrip('/')}/{MAPS}/{keys[one.map]}"})
        for one in meta.drives
    )
    write_joined(folder, meta.model_copy(update={"drives": drives}))


def _found(job: SeveralJob, count: int, storage: Storage, failed: str) -> TrackFound:
    """Return what became of a track."""
    found = TrackFound(job.name, count, job.key, tuple(drive.name for drive, _ in job.drives))
    result = storage.result(TRACKS, job.key) if not failed else None
    if result is None or result["verdict"] == REFUSED:
        return replace(
            found, reason=failed or ("the run ended before" if result is None else result["reason"])
        )
    return replace(
        found,
        joined=tuple(result["joined"]),
        left_out=result["left_out"],
        lane_cm=result["lane_cm"],
        relaid=tuple(place["text"] for place in result["relaid"]),
    )
