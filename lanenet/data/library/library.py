"""The library: drives are added, found, changed and removed."""

from __future__ import annotations

import datetime
import shutil
import sqlite3
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from lanenet.data.drives import FORMATS, open_drive
from lanenet.data.drives.recording import Drive, drive_file_of
from lanenet.data.library import database
from lanenet.data.library.entry import FIELDS, Entry, check_name, check_told, name_of
from lanenet.data.library.fingerprint import Fingerprint, checksum, take_fingerprint
from lanenet.data.library.overlap import Overlap, Recording, find_overlaps
from lanenet.data.library.relation import relation_sentence
from lanenet.errors import LanenetError, LibraryError, SameRecordingError, did_you_mean
from lanenet.outputs import lock_output, make_folder, put_in_place, remove, temporary_output

#: Where a library is, unless it is said: in the current folder.
DEFAULT_LIBRARY = Path("drives.sqlite")

#: Fingerprints in memory at a time; chosen: 10 MB of drives of 2000 frames.
_AT_A_TIME = 64
_RELATIONS = """
SELECT one.name, other.name,
  first_frame, last_frame, other_first_frame, other_last_frame, matched, same_bytes, difference
FROM relations JOIN drives AS one ON one.id = drive_id JOIN drives AS other ON other.id = other_id
"""


class Library:
    """Drives of a car, a club or a course, in one SQLite file.

    Every call opens the file anew: a library may be used by many threads and processes, and passed to them.
    """

    def __init__(self, path: Path = DEFAULT_LIBRARY) -> None:
        """Name a library; see :meth:`open`.

        Args:
            path: Its file.
        """
        self.path = Path(path)

    @classmethod
    def open(cls, path: Path = DEFAULT_LIBRARY, *, create: bool = False) -> Library:
        """Open a library.

        Args:
            path: Its file.
            create: Make it if there is none.

        Raises:
            LibraryError: If it is missing, no library, damaged, locked, or of a newer version.
        """
        library = cls(path)
        if create:
            database.create(library.path)
        with database.reading(library.path):
            return library

    @property
    def folder(self) -> Path:
        """The folder of its file, which relative sources begin at."""
        return self.path.resolve().parent

    @property
    def copies(self) -> Path:
        """The folder of the drives that were copied."""
        return self.folder / f"{self.path.stem}.files"

    def entries(self) -> list[Entry]:
        """Return all drives, in the order of their names.

        Raises:
            LibraryError: If the file cannot be read.
        """
        with database.reading(self.path) as connection:
            return [_entry(row) for row in connection.execute("SELECT * FROM drives ORDER BY name")]

    def get(self, name: str) -> Entry:
        """Return the drive of a name.

        Raises:
            LibraryError: If there is none; names the most similar one.
        """
        with database.reading(self.path) as connection:
            return self._get(connection, name)

    def path_of(self, entry: Entry) -> Path:
        """Return where a drive is, absolute."""
        return self.folder / entry.source

    def find(self, source: Path) -> Entry | None:
        """Return the drive whose files are at a path; None if the library holds none there.

        Raises:
            LibraryError: If the file cannot be read.
        """
        wanted = source.resolve()
        return next((entry for entry in self.entries() if self.path_of(entry).resolve() == wanted), None)

    def open_drive(self, name: str) -> Drive:
        """Open a drive.

        Raises:
            LibraryError: If there is none of that name, or nothing is left at its path.
            DriveFormatError: If it can no longer be read.
            CalibrationError: If its camera file cannot be used.
        """
        entry = self.get(name)
        path = self.path_of(entry)
        if not path.exists():
            raise LibraryError(
                f"{name}: its source {path} is gone; put it back, or lanenet drives remove {name}"
            )
        return open_drive(path)

    def check(self, name: str) -> None:
        """Read a drive's files and compare them with what was added.

        Raises:
            LibraryError: If its source is gone or has changed since.
            DriveFormatError: If it can no longer be read.
        """
        entry, drive = self.get(name), self.open_drive(name)
        if checksum(drive) != entry.checksum:
            raise LibraryError(
                f"{name}: its source {drive.path} has changed since it was added on {entry.added_at[:10]} "
                f"({entry.frames} frames then, {len(drive)} now); remove it and add it again"
            )

    def add(
        self,
        source: Path,
        *,
        name: str | None = None,
        copy: bool = False,
        force: bool = False,
        progress: Callable[[int, int], object] | None = None,
        **told: str | float | None,
    ) -> Entry:
        """Add a drive: read all of it, and keep what it is known by.

        Frames that it shares with drives of the library are kept as relations (:meth:`relations`).

        Args:
            source: Tub, drive folder, video or bag.
            name: Its name in the library; None makes one of the source's.
            copy: Copy it beside the library's file, instead of keeping where it is.
            force: Add it even if the library holds the same recording.
            progress: Called with (frames read, frames).
            **told: ``car``, ``camera``, ``track``, ``licence``, ``notes``, ``lane_width_cm``; the last three
                default to those of the drive's own ``drive.yaml``.

        Returns:
            The new entry.

        Raises:
            SameRecordingError: If the library holds the recording.
            LibraryError: If the name is taken or no name.
            DriveFormatError: If the drive cannot be read.
            LanenetError: If it cannot be copied.
        """
        check_told(told)
        if name is not None:
            check_name(name)
        drive = open_drive(source)
        fingerprint, found = take_fingerprint(drive, progress)
        entry = replace(self._found(drive, told), name=name or "", checksum=found)
        # Before the work; another process may still add the same.
        with database.reading(self.path) as connection:
            entry = self._placed(connection, entry, force)
        new = _New(replace(entry, name=name or ""), Recording(entry.name, fingerprint), force)
        new.compare(self._recordings())
        if not copy:
            with database.writing(self.path) as connection:
                return self._insert(connection, new)
        with lock_output(self.copies / entry.name):
            return self._add_copy(drive, replace(new, entry=entry))

    def relations(self, name: str) -> list[tuple[str, Overlap]]:
        """Return which frames a drive shares with others of the library.

        Returns:
            The other's name and the frames, in the order of both.

        Raises:
            LibraryError: If there is no such drive.
        """
        return self.all_relations().get(self.get(name).name, [])

    def relation_sentences(self, name: str) -> list[str]:
        """Say in words what a drive shares with others, a sentence for each of them.

        Raises:
            LibraryError: If there is no such drive.
        """
        found: dict[str, list[Overlap]] = {}
        for other, overlap in self.relations(name):
            found.setdefault(other, []).append(overlap)
        one = self.recording(name)
        return [relation_sentence(one, self.recording(other), overlaps) for other, overlaps in found.items()]

    def all_relations(self) -> dict[str, list[tuple[str, Overlap]]]:
        """Return what :meth:`relations` does of every drive that shares frames with another.

        Raises:
            LibraryError: If the file cannot be read.
        """
        found: dict[str, list[tuple[str, Overlap]]] = {}
        with database.reading(self.path) as connection:
            for row in connection.execute(_RELATIONS):
                one, other, *frames, matched, same_bytes, difference = row
                overlap = Overlap(
                    (frames[0], frames[1]), (frames[2], frames[3]), matched, bool(same_bytes), difference
                )
                found.setdefault(one, []).append((other, overlap))
                found.setdefault(other, []).append((one, overlap.swapped))
        return {
            name: sorted(all_, key=lambda each: (each[0], each[1].frames)) for name, all_ in found.items()
        }

    def recording(self, name: str) -> Recording:
        """Return by what a drive is known again, to compare it with others.

        Raises:
            LibraryError: If there is no such drive.
        """
        with database.reading(self.path) as connection:
            entry = self._get(connection, name)
            row = connection.execute(
                "SELECT data FROM fingerprints JOIN drives ON id = drive_id WHERE name = ?", (name,)
            ).fetchone()
        return Recording(name, Fingerprint.from_bytes(row["data"]), entry.track)

    def update(self, name: str, **told: str | float | None) -> Entry:
        """Change what people say about a drive.

        Args:
            name: The drive.
            **told: As for :meth:`add`.

        Returns:
            The entry as it is now.

        Raises:
            LibraryError: If there is no such drive, or a field cannot have that value.
        """
        check_told(told)
        with database.writing(self.path) as connection:
            entry = replace(self._get(connection, name), **told)  # type: ignore[arg-type]
            if told:
                sets = ", ".join(f"{key} = :{key}" for key in told)
                connection.execute(f"UPDATE drives SET {sets} WHERE name = :name", {**told, "name": name})
        return entry

    def remove(self, name: str, *, files: bool = False) -> Entry:
        """Remove a drive from the library.

        Args:
            name: The drive.
            files: Also remove its files, if they are a copy of the library's.

        Returns:
            What its entry was.

        Raises:
            LibraryError: If there is no such drive, or its files are to go and are not the library's.
        """
        with database.writing(self.path) as connection:
            entry = self._get(connection, name)
            inside = len(entry.source.parts) > 1 and ".." not in entry.source.parts
            if files and not (entry.copied and inside and not entry.source.is_absolute()):
                raise LibraryError(
                    f"{name}: its files in {self.path_of(entry)} are no copy of the library and stay"
                )
            connection.execute("DELETE FROM drives WHERE name = ?", (name,))
        if files:
            remove(self.folder.joinpath(*entry.source.parts[:2]))
        return entry

    def _get(self, connection: sqlite3.Connection, name: str) -> Entry:
        row = connection.execute("SELECT * FROM drives WHERE name = ?", (name,)).fetchone()
        if row is None:
            known = [each[0] for each in connection.execute("SELECT name FROM drives")]
            raise LibraryError(f"{self.path}: no drive {name!r}{did_you_mean(name, known)}")
        return _entry(row)

    def _found(self, drive: Drive, told: dict[str, str | float | None]) -> Entry:
        """Return what a drive says about itself, and people about it; name and checksum are still missing."""
        kind = next(known.kind for known in FORMATS if known.recognises(drive.path))
        path = drive.path.resolve()
        steps_s = np.diff(drive.t_s)[~drive.breaks[1:]]
        entry = Entry(
            name="",
            source=path.relative_to(self.folder) if path.is_relative_to(self.folder) else path,
            copied=False,
            kind=kind,
            car="",
            camera="",
            track="",
            licence=drive.licence,
            notes=drive.notes,
            lane_width_cm=drive.lane_width_cm,
            frames=len(drive),
            duration_s=float(steps_s.sum()),
            checksum="",
            added_at=datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        )
        return replace(entry, **told)  # type: ignore[arg-type]

    def _placed(self, connection: sqlite3.Connection, entry: Entry, force: bool) -> Entry:
        """Return the entry with its name, unless that is taken or the recording is there."""
        same = connection.execute("SELECT name FROM drives WHERE checksum = ?", (entry.checksum,)).fetchone()
        if same is not None and not force:
            raise SameRecordingError(
                f"{self.path_of(entry)}: the same recording as {same[0]} of the library: the images and "
                f"commands of all {entry.frames} frames are equal",
                str(same[0]),
            )
        taken = {row[0] for row in connection.execute("SELECT name FROM drives")}
        if entry.name:
            if entry.name in taken:
                raise LibraryError(
                    f"{self.path}: the name {entry.name!r} is taken; choose another with --name"
                )
            return entry
        # The tubs of many cars are called data: their folder tells them apart.
        own, above = name_of(self.path_of(entry)), name_of(self.path_of(entry).parent)
        numbered = (f"{own}-{number}" for number in range(2, len(taken) + 3))
        return replace(entry, name=next(n for n in (own, f"{above}-{own}"[:95], *numbered) if n not in taken))

    def _recordings(self, after: int = 0) -> Iterator[tuple[int, Recording]]:
        """Yield the drives added after one, by their numbers; nobody has to wait for who compares them."""
        while True:
            with database.reading(self.path) as connection:
                rows = list(_stored(connection, after, _AT_A_TIME))
            if not rows:
                return
            yield from rows
            after = rows[-1][0]

    def _insert(self, connection: sqlite3.Connection, new: _New) -> Entry:
        entry = self._placed(connection, new.entry, new.force)
        # Others may have been added and removed meanwhile.
        new.compare(_stored(connection, new.compared, -1))
        there = {row[0] for row in connection.execute("SELECT id FROM drives")}
        values = {**asdict(entry), "source": entry.source.as_posix(), "copied": int(entry.copied)}
        columns = ", ".join(f":{field}" for field in FIELDS)
        drive_id = connection.execute(
            f"INSERT INTO drives ({', '.join(FIELDS)}) VALUES ({columns})", values
        ).lastrowid
        data = new.recording.fingerprint.to_bytes()
        connection.execute("INSERT INTO fingerprints VALUES (?, ?)", (drive_id, data))
        connection.executemany(
            "INSERT INTO relations VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)",
            [
                (drive_id, other, *o.frames, *o.other_frames, o.matched, int(o.same_bytes), o.difference)
                for other, o in new.overlaps
                if other in there
            ],
        )
        return entry

    def _add_copy(self, drive: Drive, new: _New) -> Entry:
        """Copy a drive under a temporary name, read the copy, and give it its name with the entry's."""
        entry = new.entry
        home, inside = self.copies / entry.name, "" if drive.path.is_dir() else drive.path.name
        if home.exists():
            raise LibraryError(
                f"{home}: left of a drive that was removed; remove it, or choose another --name"
            )
        make_folder(self.copies)
        with temporary_output(home) as temporary:
            try:
                _copy(drive.path, temporary)
            except OSError as error:
                reason = error.args[0][0][2] if isinstance(error, shutil.Error) else error
                raise LanenetError(f"{home}: {drive.path} cannot be copied there ({reason})") from None
            if checksum(open_drive(temporary / inside)) != entry.checksum:
                raise LibraryError(f"{drive.path}: changed while it was copied; nothing was added")
            entry = replace(entry, source=(home / inside).relative_to(self.folder), copied=True)
            try:
                with database.writing(self.path) as connection:
                    entry = self._insert(connection, replace(new, entry=entry))
                    put_in_place(temporary, home)
            except BaseException:
                remove(home)
                raise
        return entry


@dataclass
class _New:
    """A drive that is being added.

    Attributes:
        entry: The entry, perhaps without a name.
        recording: By what it is known.
        force: Whether the library may hold it already.
        compared: Number of the last drive that it was compared with.
        overlaps: What it shares with which.
    """

    entry: Entry
    recording: Recording
    force: bool
    compared: int = 0
    overlaps: list[tuple[int, Overlap]] = field(default_factory=list)

    def compare(self, others: Iterable[tuple[int, Recording]]) -> None:
        for number, other in others:
            self.overlaps += [(number, overlap) for overlap in find_overlaps(self.recording, other)]
            self.compared = number


def _stored(connection: sqlite3.Connection, after: int, most: int) -> Iterator[tuple[int, Recording]]:
    query = "SELECT id, name, data FROM drives JOIN fingerprints ON id = drive_id WHERE id > ? ORDER BY id"
    for row in connection.execute(f"{query} LIMIT ?", (after, most)):
        yield row["id"], Recording(row["name"], Fingerprint.from_bytes(row["data"]))


def _entry(row: sqlite3.Row) -> Entry:
    values = {field: row[field] for field in FIELDS}
    return Entry(**{**values, "source": Path(row["source"]), "copied": bool(row["copied"])})


def _copy(source: Path, folder: Path) -> None:
    """Copy a drive's folder, or a drive that is one file with what lies beside it under its name."""
    if source.is_dir():
        shutil.copytree(source, folder, symlinks=True)
        return
    folder.mkdir()
    for file in (source, source.with_suffix(".csv"), drive_file_of(source)):
        if file.is_file():
            shutil.copy2(file, folder / file.name)
