"""A drive as a ROS 2 bag (a folder with ``metadata.yaml``) or as a single MCAP or SQLite file of one.

Topics are found by their types: the images, and the commands from AckermannDrive or Twist. Each frame gets
the last command before it: that which the car was obeying. Where there are several topics of a kind,
``topics`` of the drive's ``drive.yaml`` names those to use.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from lanenet.data.drives.bag.messages import COMMAND_TYPES, IMAGE_TYPES, VIDEO_REMEDY, Decoder
from lanenet.data.drives.bag.storage import METADATA_FILE, STORAGE_ENDINGS, Bag, is_bag
from lanenet.data.drives.bag.topic import OUT_OF_ORDER, READABLE, Topic
from lanenet.data.drives.recording import (
    COMMAND_SPECS,
    DRIVE_FILE,
    DRIVE_FORMAT,
    MAX_PAUSE_S,
    Commands,
    DriveFormat,
    RecordedFrames,
    drive_file_of,
    read_drive_file,
)
from lanenet.errors import DriveFormatError

_COMMANDS = ("speed_cm_s", "steering_rad", "yaw_rate_rad_s")
#: A command is obeyed until the next, but not for ever: drivers of cars stop one that hears nothing. A longer
#: pause is a break of the drive, too.
_MAX_AGE_NS = int(1e9 * MAX_PAUSE_S)
#: A stamp farther from the time of recording is of another clock: since the computer started, or simulated.
_SAME_CLOCK_NS = 2_000_000_000
#: Up to this many frames ahead, reading on is taken to be faster than a seek, which unpacks a chunk. Chosen:
#: a chunk of MCAP has a megabyte, some ten small images.
_MAX_FORWARD = 10
#: Topics that an error lists; chosen: they fit a screen.
_MAX_LISTED = 12


class BagImages:
    """Images of a bag's topic: fast in order, by seeking out of order."""

    def __init__(self, path: Path, topic: Topic, recorded_ns: Int[np.ndarray, "n"]) -> None:
        """Open the bag again.

        Args:
            path: The bag.
            topic: Topic of its images.
            recorded_ns: Time of recording of each message, as the bag gives them in order.

        Raises:
            DriveFormatError: If it cannot be read.
        """
        self.path = path
        self.topic = topic
        self._recorded_ns = recorded_ns
        self._bag = Bag(path)
        self._decoder = Decoder(topic)
        self._next = 0
        self._last = (-1, b"")
        self._stream: Iterator[tuple[int, bytes]] = iter(())

    def __reduce__(self) -> tuple[type[BagImages], tuple[Path, Topic, np.ndarray]]:
        """Pickle where the images are: another process opens the bag again."""
        return BagImages, (self.path, self.topic, self._recorded_ns)

    def read(self, row: int) -> UInt8[np.ndarray, "h w 3"]:
        """Read one image; see :class:`lanenet.data.drives.recording.ImageSource`."""
        return self._decoder.image(self.data(row), f"{self.path}: image {row} of {self.topic.name}")

    def data(self, row: int) -> bytes:
        """Return one message; see :class:`lanenet.data.drives.recording.StoredImages`."""
        if self._last[0] == row:
            return self._last[1]
        if not 0 < self._next <= row <= self._next + _MAX_FORWARD:
            # From the first of the messages that were recorded in the same nanosecond.
            self._next = int(np.searchsorted(self._recorded_ns, self._recorded_ns[row]))
            self._stream = self._bag.messages(self.topic, int(self._recorded_ns[row]))
        data = b""
        try:
            while self._next <= row:
                _, data = next(self._stream)
                self._next += 1
        except (DriveFormatError, StopIteration):
            self._next = 0
            raise DriveFormatError(f"{self.path}: image {row} of {self.topic.name} cannot be read") from None
        self._last = (row, data)
        return data


def read_bag(path: Path) -> RecordedFrames:
    """Read a bag; images stay in it.

    Speed is the message's ``speed`` or ``linear.x``, the steering angle ``steering_angle``, and the yaw rate
    ``angular.z`` of a Twist; metres become centimetres, and the signs of REP 103 are this project's.

    Raises:
        DriveFormatError: If the bag is damaged, has no images, or has several topics of images or of
            commands; lists the topics that were found.
        MissingExtraError: If rosbags or mcap is not installed.
    """
    bag = Bag(path)
    file, _ = read_drive_file(path)
    wanted = file.topics
    if absent := [name for name in wanted if name not in {topic.name for topic in bag.topics}]:
        raise DriveFormatError(f"{drive_file_of(path)}: key 'topics': no topic {absent[0]}; {_found(bag)}")
    topics = [topic for topic in bag.topics if topic.count and (not wanted or topic.name in wanted)]
    topics = [topic for topic in topics if topic.encoding in READABLE]
    pictures = _pictures(bag, [topic for topic in topics if topic.type in IMAGE_TYPES])
    if not pictures:
        raise DriveFormatError(
            f"{path}: no topic of images, expected {' or '.join(IMAGE_TYPES)}; {_found(bag)}{_remedy(bag)}"
        )
    image_topic = _only(path, "images", pictures)
    recorded_ns, t_ns, more = _image_times(bag, image_topic)
    problems = [*bag.problems, *more]
    kept = t_ns > np.concatenate([[np.iinfo(np.int64).min], np.maximum.accumulate(t_ns)[:-1]])
    if not kept.all():
        problems.append(f"{path}: {np.sum(~kept)} images are not later than one before them; left out")
    frames = np.flatnonzero(kept)
    of_type = [[topic for topic in topics if topic.type == known] for known in COMMAND_TYPES]
    commands = Commands()
    if candidates := next((found for found in of_type if found), []):
        command_topic = _only(path, "commands", candidates)
        commands, more = _commands(bag, command_topic, t_ns[frames])
        problems += more
    else:
        problems.append(f"{path}: no topic of commands, expected {' or '.join(COMMAND_TYPES)}; {_found(bag)}")
    images = BagImages(path, image_topic, recorded_ns)
    t_s = (t_ns[frames] - t_ns[frames[0]]) * 1e-9
    return RecordedFrames(frames, t_s, commands, images, tuple(problems), rows=frames)


FORMAT = DriveFormat(
    kind="bag",
    described=f"a ROS 2 bag ({METADATA_FILE}; {', '.join(STORAGE_ENDINGS)})",
    recognises=is_bag,
    read=read_bag,
    files=(
        METADATA_FILE,
        DRIVE_FILE,
        *(f"*{ending}" for ending in STORAGE_ENDINGS),
        f"{{stem}}.{DRIVE_FILE}",
    ),
)


def _found(bag: Bag) -> str:
    """List the topics of a bag, those that could be meant first: a robot has hundreds."""
    known = {kind.rpartition("/")[2] for kind in (*IMAGE_TYPES, *COMMAND_TYPES)}
    topics = sorted(bag.topics, key=lambda topic: topic.type.rpartition("/")[2] not in known)
    more = f" and {len(topics) - _MAX_LISTED} more" if len(topics) > _MAX_LISTED else ""
    return "found " + (", ".join(map(str, topics[:_MAX_LISTED])) or "no topic at all") + more


def _remedy(bag: Bag) -> str:
    """Say what to do about topics of images that cannot be read; the end of an error."""
    pictures = [topic for topic in bag.topics if re.search("image|video|packet", topic.type.lower())]
    if any(topic.encoding == "ros1" for topic in bag.topics):
        return (
            "; these are messages of ROS 1: convert the .bag that they came from: "
            f"rosbags-convert --src {shlex.quote(bag.path.stem)}.bag --dst {shlex.quote(bag.path.stem)}"
        )
    if any(re.search("video|packet", topic.type.lower()) for topic in pictures):
        return f"; {VIDEO_REMEDY}"
    if others := {topic.encoding for topic in pictures} - {*READABLE}:
        return f"; images in {', '.join(sorted(others))} are not read: record them in CDR or JSON"
    return ""


def _only(path: Path, what: str, topics: list[Topic]) -> Topic:
    if len(topics) > 1:
        raise DriveFormatError(
            f"{path}: {len(topics)} topics of {what}: {', '.join(map(str, topics))}; write into "
            f"{drive_file_of(path)} which topics to use, of images and of commands: 'format: {DRIVE_FORMAT}' "
            f"and 'topics: [{topics[0].name}, ...]'"
        )
    return topics[0]


def _pictures(bag: Bag, topics: list[Topic]) -> list[Topic]:
    """Of several topics of images, leave out depths, and one of the two of one camera."""
    if len(topics) < 2:
        return topics
    topics = [t for t in topics if any(Decoder(t).is_picture(data) for _, data in _first(bag, t))]
    by_name = {topic.name: topic for topic in topics}
    for topic in topics:
        # ROS's image_transport publishes the same images with and without loss.
        if (twin := by_name.get(f"{topic.name}/compressed")) is not None:
            del by_name[min(twin, topic, key=lambda t: t.count).name]
    return list(by_name.values())


def _first(bag: Bag, topic: Topic) -> list[tuple[int, bytes]]:
    return [message for message, _ in zip(bag.messages(topic), range(1), strict=False)]


def _image_times(bag: Bag, topic: Topic) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"], list[str]]:
    """Return when each image was recorded, when it was taken, both [ns], and what was wrong."""
    decoder, recorded, stamps, problems = Decoder(topic), [], [], []
    try:
        for t_ns, data in bag.messages(topic):
            recorded.append(t_ns)
            try:
                stamps.append(decoder.stamp_ns(decoder.message(data)))
            except (DriveFormatError, AttributeError):  # said when the image is read
                stamps.append(0)
    except DriveFormatError as error:
        if not recorded:
            raise
        problems.append(f"{error}: {len(recorded)} of {topic.count} images can be read")
    if not recorded:
        raise DriveFormatError(f"{bag.path}: {topic} has no message; {_found(bag)}")
    return np.array(recorded, np.int64), _times(recorded, stamps), problems


def _times(recorded_ns: list[int], stamps_ns: list[int]) -> Int[np.ndarray, "n"]:
    """Return the stamps, where they are of the clock of the recording, else the times of recording.

    Those of a clock that was set back by less are not used, since the times of recording go on there.
    """
    recorded, stamps = np.array(recorded_ns, np.int64), np.array(stamps_ns, np.int64)
    times = np.where(np.abs(stamps - recorded) <= _SAME_CLOCK_NS, stamps, recorded)
    back = -np.diff(times).min(initial=0)
    return recorded if back > OUT_OF_ORDER * np.median(np.diff(recorded, prepend=recorded[:1])) else times


def _commands(bag: Bag, topic: Topic, frames_ns: Int[np.ndarray, "n"]) -> tuple[Commands, list[str]]:
    """Return the command that was in force at each frame, and what was wrong."""
    decoder, recorded, rows = Decoder(topic), [], []
    for t_ns, data in bag.messages(topic):
        recorded.append(t_ns)
        rows.append(decoder.command(data))
    if not rows:
        return Commands(), [f"{bag.path}: {topic} has no message after all"]
    times_ns = _times(recorded, [row[0] for row in rows])
    order = np.argsort(times_ns, kind="stable")
    values = np.array([row[1:] for row in rows])[order]
    problems: list[str] = []
    for k, name in enumerate(_COMMANDS):
        spec = COMMAND_SPECS[name]
        outside = ~((values[:, k] >= spec.low) & (values[:, k] <= spec.high))
        if outside.any() and not np.isnan(values[:, k]).all():
            problems.append(
                f"{bag.path}: {outside.sum()} of {len(values)} messages of {topic.name} have {name} outside "
                f"{spec.low:g} to {spec.high:g}, left out (first: {values[outside, k][0]:g})"
            )
        values[outside, k] = np.nan
    held, missing = _held(frames_ns, times_ns[order], values)
    if missing.any():
        problems.append(
            f"{bag.path}: {missing.sum()} of {len(missing)} frames have no command of {topic.name} in the "
            f"{MAX_PAUSE_S:g} s before them (first: frame {np.flatnonzero(missing)[0]})"
        )
    columns = {name: held[:, k] for k, name in enumerate(_COMMANDS) if not np.isnan(held[:, k]).all()}
    return Commands(**columns), problems


def _held(
    frames_ns: Int[np.ndarray, "n"], times_ns: Int[np.ndarray, "m"], values: Float[np.ndarray, "m 3"]
) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, "n"]]:
    """Return the last values at each frame, and where they are too old or there are none yet."""
    last = np.searchsorted(times_ns, frames_ns, side="right") - 1
    missing = (last < 0) | (frames_ns - times_ns[last] > _MAX_AGE_NS)
    held = values[last]
    held[missing] = np.nan
    return held, missing
