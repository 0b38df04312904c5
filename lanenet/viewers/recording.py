"""A recording of what was seen, in all viewers that were asked for."""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from lanenet.data.files import atomic_file, check_destination
from lanenet.errors import ConfigError, LanenetError
from lanenet.viewers.drawing import Artist
from lanenet.viewers.registry import VIEWERS
from lanenet.viewers.seen import Scene, Seen
from lanenet.viewers.viewer import Viewer

log = logging.getLogger(__name__)

#: Frames that wait to be drawn while a car drives. Chosen: 0.4 s at 20 frames/s.
_WAITING = 8


class Recording:
    """Takes what was seen, frame by frame."""

    def __init__(self, artist: Artist, viewers: Sequence[Viewer]) -> None:
        self._artist, self._viewers = artist, viewers

    def add(self, seen: Seen) -> None:
        """Draw a frame and show it everywhere."""
        drawing = self._artist.draw(seen)
        for viewer in self._viewers:
            viewer.add(drawing)


def check_targets(targets: Mapping[str, str]) -> list[Path]:
    """Refuse, before the work, viewers that cannot be shown anything; return the files to write.

    Args:
        targets: Where to show it, by the viewer's name: a file, or an address that the viewer knows.

    Raises:
        ConfigError: If a file has another ending than the viewer's.
        MissingExtraError: If a viewer's package is not installed.
        LanenetError: If a file cannot be written there.
    """
    files = []
    for name, target in targets.items():
        kind = VIEWERS[name]
        if kind.is_file(target):
            path = Path(target)
            if path.suffix.lower() != kind.ending:
                raise ConfigError(f"--{name} {target}: expected {kind.metavar.replace('|', ' or ')}")
            check_destination(path)
            files.append(path)
        kind.check()
    return files


@contextmanager
def record(targets: Mapping[str, str], scene: Scene, part: str = "") -> Iterator[Recording]:
    """Record a drive; files get their names when the block ends well.

    Args:
        targets: As for :func:`check_targets`.
        scene: What stays the same.
        part: Added to the names of files, where one command makes several recordings.
    """
    artist = Artist(scene)
    with ExitStack() as stack:
        viewers = []
        for name, target in targets.items():
            place = target
            if VIEWERS[name].is_file(target):
                path = Path(target)
                path = path.with_stem(f"{path.stem}-{part}") if part else path
                place = str(stack.enter_context(atomic_file(path)))
            viewer = VIEWERS[name].open(place)
            viewer.begin(artist)
            # Before the file gets its name: the stack undoes in reverse.
            stack.callback(viewer.close)
            viewers.append(viewer)
        yield Recording(artist, viewers)


class BackgroundRecording:
    """A recording made in a thread of its own, for a car that must not wait; :meth:`add` never blocks.

    Attributes:
        dropped: Frames left out because drawing them took too long.
        problem: Why the recording stopped; empty while it runs.
    """

    def __init__(self, recording: Recording) -> None:
        """Start the thread."""
        self._recording = recording
        self._waiting: queue.Queue[Seen | None] = queue.Queue(_WAITING)
        self.dropped, self.problem = 0, ""
        self._thread = threading.Thread(target=self._run, name="viewers", daemon=True)
        self._thread.start()

    def add(self, seen: Seen) -> None:
        """Queue a frame, whose image must not be changed afterwards; drop it if too many wait."""
        try:
            self._waiting.put_nowait(seen)
        except queue.Full:
            self.dropped += 1

    def close(self) -> None:
        """Draw what waits, and end the thread."""
        self._waiting.put(None)
        self._thread.join()

    def _run(self) -> None:
        while (seen := self._waiting.get()) is not None:
            if self.problem:
                continue
            try:
                self._recording.add(seen)
            except Exception as error:
                # Any error: a viewer must not stop a car.
                self.problem = str(error) or type(error).__name__
                log.warning("viewers: stopped (%s); driving goes on", self.problem)


@contextmanager
def record_in_background(targets: Mapping[str, str], scene: Scene) -> Iterator[BackgroundRecording]:
    """Record a drive in a thread; what was seen until an error in the block is kept, and the error raised.

    Args:
        targets: As for :func:`check_targets`.
        scene: What stays the same.

    Raises:
        LanenetError: If the recording itself failed and nothing else did.
    """
    failed: BaseException | None = None
    with record(targets, scene) as recording:
        background = BackgroundRecording(recording)
        try:
            yield background
        except BaseException as error:
            failed = error
        finally:
            background.close()
    if failed is not None:
        raise failed
    if background.problem:
        raise LanenetError(f"the viewers stopped before the end: {background.problem}")
