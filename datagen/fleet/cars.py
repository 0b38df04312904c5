"""One camera for all drives of a car: found from several of them together, once they are mapped alone."""

from __future__ import annotations

import tempfile
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from datagen.fleet.engine import Engine
from datagen.fleet.meter import Meter
from datagen.fleet.result import CarFound, Labelled
from datagen.fleet.several import SeveralJob, finish, visits_of
from datagen.fleet.storage import Storage
from datagen.fleet.task import CAMERAS, MAPS, FleetDrive
from datagen.fleet.work import REFUSED, REJECTED, Outcome, attempted, mark, version
from datagen.made import key_of
from datagen.tracks.cameras import DriveCamera, camera_sigma
from datagen.tracks.car import agreeing_drives, camera_of_car, may_be_one, unlike
from lanenet.data.camera_file import read_camera, sigma_residuals, write_camera
from lanenet.errors import MapFormatError, TrackingLostError
from lanenet.reading import read_json

CAMERA_NAME = "camera.yaml"
#: A camera is found from so many drives at most, those that know the focal length best. Chosen: more drives
#: make it hardly better known, and a drive that is new changes nothing unless it is one of the best.
_MOST_DRIVES = 4


def without_camera(drives: Sequence[FleetDrive]) -> dict[str, list[int]]:
    """Return the drives of each car whose camera is not given, by their places, where there are several."""
    cars: dict[str, list[int]] = defaultdict(list)
    for place, drive in enumerate(drives):
        if drive.car and drive.camera is None and drive.checksum:
            cars[drive.car].append(place)
    return {car: places for car, places in cars.items() if len(places) > 1}


def find_cameras(
    cars: dict[str, list[Labelled]], storage: Storage, engine: Engine, refused_again: bool = False
) -> tuple[list[CarFound], str]:
    """Find the camera of each car, unless that was done before.

    Args:
        cars: The drives of each car, mapped alone.
        storage: Where results are kept.
        engine: What spreads the work.
        refused_again: Look for cameras again where none was found before.

    Returns:
        The cars, and which disk was full.
    """
    found = [_compared(car, drives, storage) for car, drives in cars.items()]
    jobs = []
    for car in found:
        drives = {drive.map_key: drive.drive for drive in cars[car.name]}
        chosen = tuple((drives[key], key) for key in car.from_maps)
        if car.key:
            jobs.append(SeveralJob(car.name, chosen, storage.url, car.key, version()))
    failed, disk_full = finish(jobs, CAMERAS, find_camera, storage, engine, "camera of ", refused_again)
    return [_with_result(car, storage, failed.get(car.key, "")) for car in found], disk_full


def find_camera(job: SeveralJob) -> Outcome:
    """Find the camera of a car from its drives; a function of a module, since workers call it."""
    return attempted(job.made_by, lambda: _find_camera(job))


def _find_camera(job: SeveralJob) -> Outcome:
    storage, meter = Storage(job.out), Meter()
    marker = {"car": job.name, "drives": [drive.name for drive, _ in job.drives]}
    with visits_of(job, storage) as by_name, storage.new(CAMERAS, job.key) as folder:
        visits = list(by_name.values())
        try:
            found = camera_of_car(visits, np.random.default_rng(visits[0].prepared.settings.seed))
        except TrackingLostError as error:
            mark(folder, {**marker, "verdict": REFUSED, "reason": str(error)}, meter)
            return Outcome(REFUSED, str(error))
        how = f"from {', '.join(by_name)} together"
        sigma = sigma_residuals(found.camera, found.sigma)
        write_camera(folder / CAMERA_NAME, found.camera, how, sigma)
        facts = {"sigma": found.sigma, "heights_cm": [None if h != h else h for h in found.height_cm]}
        mark(folder, {**marker, "verdict": "found", "reason": "", **facts}, meter)
    return Outcome("found")


def with_camera(drive: FleetDrive, car: CarFound, storage: Storage) -> FleetDrive:
    """Return a drive with its car's camera, which says how high it is."""
    path = f"{storage.url.rstrip('/')}/{CAMERAS}/{car.key}/{CAMERA_NAME}"
    return replace(drive, camera=path, camera_height_cm=None)


def _compared(car: str, drives: Sequence[Labelled], storage: Storage) -> CarFound:
    """Test whether the drives of a car had one camera, and choose those that show it best."""
    mapped = {drive.map_key: drive.drive.name for drive in drives if drive.has_labels}
    rejected = {drive.map_key: drive.drive.name for drive in drives if drive.verdict == REJECTED}
    of_maps = _cameras([*mapped, *rejected], storage)
    cameras = {key: camera for key, camera in of_maps.closed.items() if key in mapped}
    keys, names = list(cameras), [mapped[key] for key in cameras]
    agreeing, odd = agreeing_drives(list(cameras.values())) if cameras else ([], [])
    reasons = {names[one.place]: f"another camera than that of {names[one.than]}: {one.text}" for one in odd}
    for key, camera in of_maps.open.items():
        # What an open drive says of its lens is little, but it tells a camera that was turned.
        if key in mapped and agreeing and not may_be_one(cameras[keys[agreeing[0]]], camera):
            other = unlike(camera, cameras[keys[agreeing[0]]])
            reasons[mapped[key]] = f"another camera than that of {names[agreeing[0]]}: {other}"
    every = mapped | rejected
    reasons |= {every[key]: "has a camera of its own" for key in of_maps.given}
    reasons |= {every[key]: f"{storage.url}/{MAPS}/{key}: cannot be read" for key in of_maps.unreadable}
    if len(agreeing) < 2:
        few = f"expected two drives that show it and agree, found {len(agreeing)} of {len(drives)} drives"
        return CarFound(car, tuple(drive.drive.name for drive in drives), own=reasons, reason=few)
    chosen = tuple(sorted(keys[k] for k in agreeing[:_MOST_DRIVES]))
    return CarFound(
        car,
        tuple(drive.drive.name for drive in drives),
        key_of(CAMERAS, chosen),
        chosen,
        tuple(mapped[key] for key in chosen),
        reasons,
    )


class _Cameras(NamedTuple):
    """Cameras that maps have, by the keys of the maps.

    Attributes:
        closed: Found by a drive that closed a loop.
        open: Found by one that did not, so that the lens is a guess.
        given: Maps whose camera was given.
        unreadable: Maps of which a file is missing.
    """

    closed: dict[str, DriveCamera]
    open: dict[str, DriveCamera]
    given: list[str]
    unreadable: list[str]


def _cameras(keys: Sequence[str], storage: Storage) -> _Cameras:
    """Read the cameras of maps."""
    read = _Cameras({}, {}, [], [])
    files = {name: storage.read_all(MAPS, keys, name) for name in (CAMERA_NAME, "report.json")}
    with tempfile.TemporaryDirectory(prefix="lanenet-") as temporary:
        folder = Path(temporary)
        for key in keys:
            if not all(data.get(key) for data in files.values()):
                read.unreadable.append(key)
                continue
            for name, data in files.items():
                (folder / name).write_bytes(data[key])
            calibration = read_json(folder / "report.json", MapFormatError).get("calibration")
            if calibration is None:
                read.given.append(key)
                continue
            camera = DriveCamera(key, read_camera(folder / CAMERA_NAME), camera_sigma(folder))
            (read.closed if calibration.get("closed") else read.open)[key] = camera
    return read


def _with_result(car: CarFound, storage: Storage, failed: str) -> CarFound:
    """Return a car with its camera, or with the reason why there is none."""
    result = storage.result(CAMERAS, car.key) if car.key and not failed else None
    if result is None or result["verdict"] == REFUSED:
        reason = failed or car.reason or ("the run ended before" if result is None else result["reason"])
        return replace(car, key="", reason=reason)
    data = storage.read(CAMERAS, car.key, CAMERA_NAME)
    if not data:
        missing = f"{storage.url}/{CAMERAS}/{car.key}/{CAMERA_NAME}: cannot be read"
        return replace(car, key="", reason=missing)
    with tempfile.TemporaryDirectory(prefix="lanenet-") as folder:
        file = Path(folder) / CAMERA_NAME
        file.write_bytes(data)
        return replace(car, camera=read_camera(file), sigma=result["sigma"])
