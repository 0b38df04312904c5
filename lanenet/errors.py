"""The errors that lanenet raises for bad input.

    LanenetError
    |- ConfigError           a setting: misspelt key, wrong type, empty range
    |- CalibrationError      a camera file, or pixels that the camera cannot see
    |- DriveFormatError      a recorded drive: tub, frames.csv, images, video
    |- LibraryError          a library of drives: its file, or a drive in it
    |- MapFormatError        a map folder
    |- LabelFormatError      a label set or a table of detections
    |- CheckpointError       a checkpoint folder
    |- TrackingLostError     the drive cannot be mapped
    |- ModelMismatchError    a model that does not fit this camera or window
    |- MissingExtraError     a package of an extra that is not installed
    |- HardwareError         a camera or an actuator that does not answer
       |- MotorMayRunError   neutral could be confirmed and was not

A message names what was found, what was expected and where (file, key, frame).
"""

import difflib
import re
from collections.abc import Iterable, Sequence


def did_you_mean(name: str, known: Iterable[str], least: float = 0.6) -> str:
    """Return the end of a message about an unknown name: the most similar known one, or an empty text.

    Args:
        name: What was found.
        known: What was expected.
        least: Smallest similarity, from 0 to 1 (``difflib``).
    """
    close = difflib.get_close_matches(name, list(known), n=1, cutoff=least)
    return f", did you mean {close[0]!r}?" if close else ""


def counted(number: int, word: str) -> str:
    """Return a count of things in words: "1 frame", "2 frames"."""
    return f"{number} {word}{'' if number == 1 else 's'}"


#: What a terminal takes for commands (all control characters but tab and line feed), marks that turn the
#: direction of writing, and halves of characters: names that are no UTF-8 have them, and printing fails.
_UNPRINTABLE = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")


def printable(text: str) -> str:
    """Return a text that may hold names from files as a terminal can show it: control characters by code."""
    return _UNPRINTABLE.sub(lambda found: ascii(found[0])[1:-1], text)


class LanenetError(Exception):
    """Base of all errors of the input, shown to the user as one line.

    Attributes:
        exit_code: Of the command that ends with the error.
        hints: Shown below it, a line each: what to look at, and commands to be copied.
    """

    exit_code = 1

    def __init__(self, *message: object, hints: Sequence[str] = ()) -> None:
        super().__init__(*message)
        self.hints = tuple(hints)


class ConfigError(LanenetError):
    """A setting is unknown, of the wrong type or out of range."""


class CalibrationError(LanenetError):
    """A camera file cannot be used, or does not fit the images."""


class DriveFormatError(LanenetError):
    """A recorded drive cannot be read."""


class UnreadableFrameError(DriveFormatError):
    """An image of a drive cannot be read; the others may be."""


class LibraryError(LanenetError):
    """A library of drives cannot be used, or does not hold a drive as it is asked for."""


class SameRecordingError(LibraryError):
    """A library holds the recording already.

    Attributes:
        name: Its name there.
    """

    def __init__(self, message: str, name: str) -> None:
        super().__init__(message)
        self.name = name


class MapFormatError(LanenetError):
    """A map folder cannot be read."""


class LabelFormatError(LanenetError):
    """A label set or table of detections cannot be read."""


class CheckpointError(LanenetError):
    """A checkpoint folder cannot be read or does not fit the config."""


class TrackingLostError(LanenetError):
    """The drive does not determine a map."""


class NoLaneError(TrackingLostError):
    """No two lines along the drive bound a lane."""


class ModelMismatchError(LanenetError):
    """A model is for another camera, window or format."""


class MissingExtraError(LanenetError):
    """A package of an extra is not installed."""


class HardwareError(LanenetError):
    """A camera or an actuator is missing, or does not answer."""


class MotorMayRunError(HardwareError):
    """The hardware has not confirmed neutral: a person has to disconnect the battery.

    The exit code stands in ``RestartPreventExitStatus=`` of ``contrib/lanenet.service``.
    """

    exit_code = 4
