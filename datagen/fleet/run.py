"""Label all drives of a list: what is new is done, by an engine, and what is finished is used."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace

from datagen.fleet.cars import find_cameras, with_camera, without_camera
from datagen.fleet.engine import Engine
from datagen.fleet.page import write_page
from datagen.fleet.result import CarFound, FleetResult, Labelled, write_index
from datagen.fleet.stage import Finished, Progress, Stage
from datagen.fleet.storage import Storage
from datagen.fleet.task import CAMERAS, LABELS, MAPS, TRACKS, FleetDrive, FleetSettings
from datagen.fleet.tracks import join_tracks, named_tracks, recognised_tracks
from datagen.fleet.work import REFUSED, REJECTED
from lanenet.outputs import lock_output

#: Verdicts of maps, the best first.
_GRADES = ("good", "usable", REJECTED, REFUSED)


def label_all(
    drives: Sequence[FleetDrive],
    settings: FleetSettings,
    storage: Storage,
    engine: Engine,
    progress: Progress | None = None,
    refused_again: bool = False,
    each_alone: bool = False,
    find_tracks: bool = False,
) -> FleetResult:
    """Map and label drives, as far as that has not been done with the same settings.

    A drive is one task. Drives that are gone, that cannot be mapped or whose camera cannot be read, tasks
    that fail and workers that are lost stop nothing; a full disk ends the run. What is finished is kept in
    any case, also at Ctrl-C.

    Drives of one car are mapped alone first, and then with the camera that is found from them together, see
    :mod:`datagen.fleet.cars`. Maps of one track are joined at the end, see :mod:`datagen.fleet.tracks`.

    Args:
        drives: Drives with their checksums.
        settings: What they are made with.
        storage: Where results are kept; no other run may write there.
        engine: What spreads the tasks.
        progress: Called whenever a drive has ended; counts begin anew with each stage.
        refused_again: Try drives, cameras and joins again that were refused before.
        each_alone: Neither look for cameras of cars nor join maps.
        find_tracks: Recognise the track of drives that name none, which compares all pairs of maps.

    Raises:
        LanenetError: If another run writes there, if files of others have the names that are used there, or
            if the engine cannot be started.
    """
    with ExitStack() as stack:
        if storage.folder is not None:
            stack.enter_context(lock_output(storage.folder))
        storage.claim()
        for kind in (MAPS, LABELS, CAMERAS, TRACKS):
            storage.sweep(kind)
        run = _Run(settings, storage, engine, progress, refused_again)
        cars: dict[str, list[int]] = {} if each_alone else without_camera(drives)
        result = run.label(drives, cars)
        if not (each_alone or result.disk_full):
            result = run.join(result, find_tracks)
        write_index(result, storage)
        write_page(result, storage)
        return result


@dataclass
class _Run:
    """A run: its stages one after the other.

    Attributes:
        settings, storage, engine, progress, refused_again: See :func:`label_all`.
        tried: Keys of the maps of drives for which something was done.
    """

    settings: FleetSettings
    storage: Storage
    engine: Engine
    progress: Progress | None
    refused_again: bool
    tried: set[str] = field(default_factory=set)

    def label(self, drives: Sequence[FleetDrive], cars: dict[str, list[int]]) -> FleetResult:
        """Map drives with the cameras of their cars, where there are any, and label all of them."""
        chosen, found_cars = list(drives), list[CarFound]()
        alone: dict[int, Labelled] = {}
        # A recording that is listed twice gets the camera of the first: else it would be labelled twice.
        first = self._first_listings(drives) if cars else {}
        cars = {car: [k for k in group if k not in first] for car, group in cars.items()}
        cars = {car: group for car, group in cars.items() if len(group) > 1}
        if cars:
            places = [place for group in cars.values() for place in group]
            stage = self._finish(
                Stage([drives[k] for k in places], self.settings, self.storage, labels=False)
            )
            alone = dict(zip(places, stage.drives, strict=True))
            disk_full = stage.disk_full
            if not disk_full:
                groups = {car: [alone[k] for k in group] for car, group in cars.items()}
                found_cars, disk_full = find_cameras(groups, self.storage, self.engine, self.refused_again)
            if disk_full:
                return self._ended(chosen, found_cars, disk_full)
            for car in found_cars:
                for place in cars[car.name] if car.key else ():
                    if drives[place].name not in car.own:
                        chosen[place] = with_camera(drives[place], car, self.storage)
        _as_the_first(chosen, first)
        stage = self._finish(Stage(chosen, self.settings, self.storage))
        worse = {
            place: stage.drives[place]
            for place, before in alone.items()
            if chosen[place] is not drives[place] and _is_worse(stage.drives[place], before)
        }
        if worse and not stage.disk_full:
            for place, with_it in worse.items():
                chosen[place] = drives[place]
                car = next(car for car in found_cars if drives[place].name in car.drives)
                car.own[drives[place].name] = _why_worse(with_it, alone[place])
            _as_the_first(chosen, first)
            stage = self._finish(Stage(chosen, self.settings, self.storage))
        return self._ended(chosen, found_cars, stage.disk_full, stage.drives)

    def join(self, result: FleetResult, find_tracks: bool) -> FleetResult:
        """Join the maps of each track."""
        tracks, failed = named_tracks(result.drives), list[str]()
        if find_tracks:
            tracks, failed = recognised_tracks(result.drives, self.storage, self.engine)
        found, disk_full = join_tracks(tracks, self.storage, self.engine, self.refused_again)
        return replace(result, tracks=tuple(found), uncompared=tuple(failed), disk_full=disk_full)

    def _first_listings(self, drives: Sequence[FleetDrive]) -> dict[int, int]:
        """Return for drives that were listed before, by their places, where that was."""
        first, again = dict[str, int](), dict[int, int]()
        for place, key in enumerate(Stage(drives, self.settings, self.storage).keys[MAPS]):
            if first.setdefault(key, place) != place:
                again[place] = first[key]
        return again

    def _finish(self, stage: Stage) -> Finished:
        if self.refused_again:
            again = stage.refused_keys() - self.tried
            stage.sweep(again)
        finished = stage.finish(self.engine, self.progress)
        for drive in finished.drives:
            if drive.new:
                self.tried |= {drive.map_key, drive.labels_key}
        return finished

    def _ended(
        self,
        drives: Sequence[FleetDrive],
        cars: Sequence[CarFound],
        disk_full: str,
        found: Sequence[Labelled] | None = None,
    ) -> FleetResult:
        """Return how all drives stand; what was done for one in an earlier stage counts as well."""
        standing = Stage(drives, self.settings, self.storage).look() if found is None else found
        drives_found = [replace(one, new=one.new or one.map_key in self.tried) for one in standing]
        return FleetResult(tuple(drives_found), disk_full, tuple(cars))


def _as_the_first(drives: list[FleetDrive], first: Mapping[int, int]) -> None:
    """Give drives that are listed twice what their first listing has of a camera."""
    for place, at in first.items():
        one = drives[at]
        drives[place] = replace(drives[place], camera=one.camera, camera_height_cm=one.camera_height_cm)


def _is_worse(found: Labelled, alone: Labelled) -> bool:
    """Tell whether a drive has a worse map with its car's camera than with its own."""
    if alone.verdict not in _GRADES or found.verdict not in _GRADES:
        return False
    return _GRADES.index(found.verdict) > _GRADES.index(alone.verdict)


def _why_worse(found: Labelled, alone: Labelled) -> str:
    why = found.reason or "; ".join((found.mapped or {}).get("reasons", ()))
    return f"with the car's camera its map is {found.verdict}, with its own {alone.verdict}: {why}"
