"""A Donkeycar's ``myconfig.py`` as settings of its PCA9685; the file is parsed, never run.

Donkeycar has three forms for a servo and a speed controller, and its drive-train type chooses:

- ``I2C_SERVO``, or ``SERVO_ESC`` up to 4.1 and in the basic template: channels, address and bus;
- ``PWM_STEERING_THROTTLE`` of 4.3.3 to 4.3.5: pins, scales and inversion at the top level;
- ``PWM_STEERING_THROTTLE`` of later versions: the same names and the pulses in a dictionary.

Source: donkeycar 4.3.0, 5.0, 5.3 and 5.4, ``templates/complete.py``, ``basic.py`` and ``cfg_*.py``,
``parts/actuator.py``, ``parts/pins.py``, ``config.py``; issues 945, 989 and 994 for pins at the top level.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lanenet.config import check_settings
from lanenet.errors import ConfigError
from lanenet.onboard.actuators.assignments import Assignment, read_assignments
from lanenet.onboard.actuators.pca9685 import OSCILLATOR_HZ, PCA9685Settings, prescale_of
from lanenet.onboard.actuators.pulses import LONGEST_US, SHORTEST_US
from lanenet.reading import parsing

#: Donkeycar counts pulses in 4096ths of a period at 60 Hz, which no name of its files changes; [us].
_COUNT_US = 1e6 * (prescale_of(60.0) + 1) / OSCILLATOR_HZ
#: For example ``PCA9685.1:40.7``: bus, hexadecimal address, channel.
_PIN = re.compile(r"PCA9685\.(\d+):((?:0x)?[0-9a-fA-F]+)\.(\d+)")
_TYPE, _DICTIONARY = "DRIVE_TRAIN_TYPE", "PWM_STEERING_THROTTLE"
_CHANNEL_TYPES = ("I2C_SERVO", "SERVO_ESC")
#: Donkeycar's names and what they set.
_PULSES = {
    "STEERING_LEFT_PWM": "steering_left_us",
    "STEERING_RIGHT_PWM": "steering_right_us",
    "THROTTLE_FORWARD_PWM": "throttle_forward_us",
    "THROTTLE_STOPPED_PWM": "throttle_stopped_us",
    "THROTTLE_REVERSE_PWM": "throttle_reverse_us",
}
_CHANNELS = {
    "STEERING_CHANNEL": "steering_channel",
    "THROTTLE_CHANNEL": "throttle_channel",
    "PCA9685_I2C_ADDR": "address",
    "PCA9685_I2C_BUSNUM": "bus",
}
#: A pin sets address and bus, too; a scale multiplies the pulses.
_PINS = {
    "PWM_STEERING_PIN": "steering_channel",
    "PWM_THROTTLE_PIN": "throttle_channel",
    "PWM_STEERING_SCALE": "scale",
    "PWM_THROTTLE_SCALE": "scale",
    "PWM_STEERING_INVERTED": "inverted",
    "PWM_THROTTLE_INVERTED": "inverted",
}
_USED = {*_PULSES, *_CHANNELS, *_PINS, _TYPE, _DICTIONARY}
#: Names that stand for other outputs, unless they are known: a fork's second chip, an Arduino.
_FOREIGN = re.compile("PCA9685_|STEERING_ARDUINO_|THROTTLE_ARDUINO_")
#: What Donkeycar calls a setting that stands in no file.
_NAME_OF = {setting: name for name, setting in (_CHANNELS | _PULSES).items()}
#: Lowest and highest value of the settings that end like this, and what is expected in Donkeycar's file.
_RANGES = {
    "channel": (0, 15, "a channel from 0 to 15"),
    "address": (0x03, 0x77, "an I2C address from 0x03 to 0x77"),
    "bus": (0, 255, "an I2C bus from 0 to 255"),
    "us": (
        SHORTEST_US,
        LONGEST_US,
        f"{math.ceil(SHORTEST_US / _COUNT_US)} to {int(LONGEST_US / _COUNT_US)}, which is 0.5 to 2.5 ms",
    ),
}
_ELSE = "or let Donkeycar move this car, with lanenet as its pilot (docs/raspberry_pi.md)"


@dataclass(frozen=True)
class _Found:
    """The value of a setting of :class:`PCA9685Settings`, and the name and the line that give it."""

    value: int | float
    name: str
    given: Assignment
    scale: float = 1.0

    def __str__(self) -> str:
        scale = "" if self.scale == 1.0 else f" times {self.scale:g}"
        return f"{self.name} {self.given.value!r}{scale} ({self.given.path.name}, line {self.given.line})"


def settings_from_myconfig(path: Path) -> dict[str, Any]:
    """Return what a Donkeycar's files say about its PCA9685, as keys of :class:`PCA9685Settings`.

    ``config.py`` beside ``myconfig.py`` holds Donkeycar's defaults and is read first, as Donkeycar does.

    Args:
        path: ``myconfig.py``.

    Returns:
        Only what the files say: channels, address and bus; pulses, [us].

    Raises:
        ConfigError: If a file is not Python or not only plain lines set the outputs, the car has no PCA9685,
            a value is not of Donkeycar's type or out of range, one is missing, or two lines disagree.
    """
    # Python writes no number of more than 4300 digits, not even into an error.
    with parsing(path, ConfigError):
        return {setting: item.value for setting, item in _settings(path).items()}


def with_myconfig(settings: PCA9685Settings) -> PCA9685Settings:
    """Fill unset settings from ``settings.myconfig``.

    Raises:
        ConfigError: If the file cannot be used, or its values do not fit together.
    """
    if settings.myconfig is None:
        return settings
    path = settings.myconfig.expanduser()
    own = settings.model_dump(exclude_unset=True)
    with parsing(path, ConfigError):
        found = {setting: item for setting, item in _settings(path).items() if setting not in own}
    values = {**{setting: item.value for setting, item in found.items()}, **own}
    try:
        # Once without the file's name, so that no rule waits for what the file may say.
        check_settings(PCA9685Settings, {k: v for k, v in values.items() if k != "myconfig"}, str(path))
    except ConfigError as error:
        raise ConfigError(_in_names_of_donkeycar(str(error), found, own)) from None
    return check_settings(PCA9685Settings, values, str(path))


def _settings(path: Path) -> dict[str, _Found]:
    """Read both files and return the settings of the form that moves the car."""
    lines: dict[str, Assignment] = {}
    base = path.with_name("config.py")
    for file in dict.fromkeys([base, path] if base.is_file() else [path]):
        lines |= read_assignments(file, _is_used, _DICTIONARY)
    section = lines.get(_DICTIONARY)
    if section is not None and not isinstance(section.value, dict):
        raise _refused(_DICTIONARY, section, "a dictionary, as in Donkeycar's config.py")
    forms = {
        "dictionary": ({} if section is None else section.entries, _PINS | _PULSES),
        "pins": (lines, _PINS | _PULSES),
        "channels": (lines, _CHANNELS | _PULSES),
    }
    chosen = _chosen_forms(lines)
    found: dict[str, _Found] = {}
    for form in chosen:
        for setting, item in _read(*forms[form]).items():
            if item.value != found.setdefault(setting, item).value:
                raise _disagree(item, found[setting])
    # What a person wrote into myconfig.py does not give way in silence to a default of config.py.
    for form in forms.keys() - chosen:
        written = {name: given for name, given in forms[form][0].items() if given.path == path}
        others: dict[str, _Found] = {}
        with suppress(ConfigError, ValueError):
            others = _read(written, forms[form][1])
        for setting, item in others.items():
            if setting in found and found[setting].given.path != path and found[setting].value != item.value:
                raise _disagree(item, found[setting])
    return found


def _is_used(name: str) -> bool:
    return name in _USED or _FOREIGN.match(name) is not None


def _chosen_forms(lines: Mapping[str, Assignment]) -> list[str]:
    """Return the forms that may move the car: several where the files do not tell.

    Raises:
        ConfigError: If it is another drive train, or names are missing without which no output is known.
    """
    kind, section = lines.get(_TYPE), lines.get(_DICTIONARY)
    pins, channels, pulses = ([n for n in names if n in lines] for names in (_PINS, _CHANNELS, _PULSES))
    forms = {"dictionary": section is not None, "pins": bool(pins)}
    if kind is None:
        forms["channels"] = bool(channels or (not pins and (pulses or section is None)))
    elif kind.value == _DICTIONARY:
        forms["pins"] |= section is None
    elif kind.value in _CHANNEL_TYPES:
        forms = {"channels": True}
    else:
        known = " or ".join(map(repr, (_DICTIONARY, *_CHANNEL_TYPES)))
        raise _refused(_TYPE, kind, f"{known}, a servo and a speed controller on a PCA9685; {_ELSE}")
    given, missing = kind, [n for n in ("PWM_STEERING_PIN", "PWM_THROTTLE_PIN") if n not in pins]
    if section is not None and forms.get("dictionary"):
        given, missing = section, [n for n in (*_PINS, *_PULSES) if n not in section.entries]
    elif pins:
        given = lines[pins[0]]
    if given is not None and missing and (forms.get("dictionary") or forms.get("pins")):
        raise ConfigError(
            f"{given.where}: {_DICTIONARY} without {', '.join(missing)}; expected all of its names, since "
            "Donkeycar has no defaults for them; add what is missing, as in Donkeycar's config.py"
        )
    for name, given in lines.items():
        if forms.get("channels") and _FOREIGN.match(name) and name not in _CHANNELS:
            raise ConfigError(
                f"{given.where}: {name}: found a name of other outputs, expected a servo and a speed "
                f"controller on one PCA9685; delete the line if the car has these, {_ELSE}"
            )
    return [form for form, may_move in forms.items() if may_move]


def _read(lines: Mapping[str, Assignment], names: Mapping[str, str]) -> dict[str, _Found]:
    """Return the settings that the lines of one form give.

    Raises:
        ConfigError: Naming the line, if a value is not one that Donkeycar takes for a PCA9685.
    """
    found: dict[str, _Found] = {}
    for name, setting in names.items():
        given, scale = lines.get(name), 1.0
        if given is None:
            continue
        values: dict[str, int | float] = {}
        if name in _PULSES:
            scale_name = f"PWM_{name.partition('_')[0]}_SCALE"
            if scale_name in names and scale_name in lines:
                scale = _number(scale_name, lines[scale_name], "a positive number")
            values = {setting: round(int(_number(name, given, "a number") * scale) * _COUNT_US, 3)}
        elif setting == "inverted" and given.value:
            raise _refused(name, given, "False, since inverted signals are not supported")
        elif name.endswith("_PIN"):
            pin = _PIN.fullmatch(str(given.value))
            if pin is None:
                raise _refused(name, given, f"a pin of a PCA9685, for example 'PCA9685.1:40.1'; {_ELSE}")
            values = {"bus": int(pin[1]), "address": int(pin[2], 16), setting: int(pin[3])}
        elif name in _CHANNELS and not (setting == "bus" and given.value is None):
            # Bus None is the one on the header, which is the default here, too.
            values = {setting: _number(name, given, "a whole number")}
        for key, value in values.items():
            low, high, words = _RANGES[key.rpartition("_")[2]]
            if not low <= value <= high:
                raise _refused(name, given, words if scale == 1.0 else f"{words}, after its scale {scale:g}")
            item = _Found(value, name, given, scale)
            if value != found.setdefault(key, item).value:
                raise ConfigError(
                    f"{given.where}: steering and throttle are on two chips, expected one: {item} and "
                    f"{found[key]}; {_ELSE}"
                )
    return found


def _number(name: str, given: Assignment, expected: str) -> int | float:
    value, kinds = given.value, int if "whole" in expected else int | float
    # Far beyond every range, and products of two such numbers are finite.
    is_number = isinstance(value, kinds) and not isinstance(value, bool) and abs(value) < 1e9
    if not is_number or ("positive" in expected and value <= 0):
        raise _refused(name, given, expected)
    return value


def _in_names_of_donkeycar(text: str, found: Mapping[str, _Found], own: Mapping[str, Any]) -> str:
    """Return an error about settings with Donkeycar's names and lines; ``own`` are of the car's file."""
    for setting, name in _NAME_OF.items():
        if setting not in own:
            default = PCA9685Settings.model_fields[setting].default
            count = default / _COUNT_US if setting in _PULSES.values() else default
            said = str(found.get(setting, f"{name} {count:g} (Donkeycar's default)"))
            # Bus and address are words of the sentence, too.
            text = re.sub(rf"\b{setting}\b(?!=)", name if "_" in setting else setting, text)
            text = re.sub(rf"\b{setting}=[-+.\w]+", said.replace("\\", r"\\") + r" [\g<0>]", text)
    return f"{text}; correct the lines, or set the keys in brackets under actuator: in the car's file"


def _refused(name: str, given: Assignment, expected: str) -> ConfigError:
    return ConfigError(f"{given.where}: {name}: found {repr(given.value)[:60]}, expected {expected}")


def _disagree(item: _Found, first: _Found) -> ConfigError:
    return ConfigError(
        f"{item.given.where}: found {item}, but also {first}, and it is not certain which moves this car; "
        f"expected the same from both: delete the wrong one, or set {_TYPE} and the names of its form here"
    )
