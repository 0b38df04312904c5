"""A Donkeycar's ``myconfig.py`` as settings of its PCA9685; the file is parsed, never run.

Source: donkeycar 5.3, ``templates/complete.py`` (``add_drivetrain``), ``parts/pins.py`` and
``templates/cfg_complete.py``; the older names belong to ``DRIVE_TRAIN_TYPE = "I2C_SERVO"``.
"""

from __future__ import annotations

import ast
import io
import math
import operator
import re
import tokenize
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from lanenet.config import check_settings
from lanenet.errors import ConfigError
from lanenet.onboard.actuators.pca9685 import OSCILLATOR_HZ, PCA9685Settings, prescale_of
from lanenet.reading import MEBIBYTE, parsing, read_text

#: Donkeycar counts pulses in 4096ths of a period at this nominal rate.
_FREQUENCY_HZ = 60.0
#: For example ``PCA9685.1:40.7``: bus, hexadecimal address, channel.
_PIN = re.compile(r"PCA9685\.(\d+):([0-9a-fA-F]+)\.(\d+)")
#: Donkeycar's dictionary of a servo and a motor on one PCA9685.
_SECTION = "PWM_STEERING_THROTTLE"
_PULSES = {
    "STEERING_LEFT_PWM": "steering_left_us",
    "STEERING_RIGHT_PWM": "steering_right_us",
    "THROTTLE_FORWARD_PWM": "throttle_forward_us",
    "THROTTLE_STOPPED_PWM": "throttle_stopped_us",
    "THROTTLE_REVERSE_PWM": "throttle_reverse_us",
}
_OLD_PLACES = {
    "STEERING_CHANNEL": "steering_channel",
    "THROTTLE_CHANNEL": "throttle_channel",
    "PCA9685_I2C_ADDR": "address",
    "PCA9685_I2C_BUSNUM": "bus",
}
#: All names of these files that this module uses.
_USED = {
    *_PULSES, *_OLD_PLACES, _SECTION, "DRIVE_TRAIN_TYPE", "PWM_STEERING_SCALE", "PWM_THROTTLE_SCALE",
}  # fmt: skip
#: Ways to change a variable without binding its name; a dictionary changes under any other name.
_UNFOLLOWED = {
    _SECTION, "*", "globals", "locals", "vars", "getattr", "setattr", "delattr", "exec", "eval", "__dict__",
    "__setattr__", "__globals__", "f_globals", "f_locals", "builtins", "__builtins__", "__import__",
    "__self__", "modules",
}  # fmt: skip
_OPERATORS: dict[type, Callable[[Any, Any], Any]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv,
    ast.FloorDiv: operator.floordiv,
}  # fmt: skip


def read_assignments(path: Path) -> dict[str, Any]:
    """Read the plain ``NAME = value`` lines of a Python file without running it.

    Values are literals, earlier names, and sums, differences, products and quotients of these. Others are
    left out. Later lines replace earlier ones.

    Args:
        path: The file.

    Raises:
        ConfigError: If the file is missing or is not Python; naming the line, if it sets or may change
            something of :func:`settings_from_myconfig` in another way.
    """
    text = read_text(path, ConfigError, MEBIBYTE)
    try:
        tree = ast.parse(text, str(path))
        _check_encoding(text)
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise ConfigError(f"{path}: not Python: {error}") from None
    plain = [(statement.lineno, *_plain_assignment(statement)) for statement in tree.body]
    targets = {target for _, names, _ in plain for target in names}
    # Names that are bound in other ways are never known: a function may change them at any time.
    bound: set[str] = set()
    for part in ast.walk(tree):
        names = [] if part in targets else _bound(part)
        bound.update(names)
        names = [name for name in names if name in _USED]
        names += [] if part in targets else [name for name in _mentioned(part) if name in _UNFOLLOWED]
        if names:
            raise _not_understood(path, getattr(part, "lineno", 0), names[0])
    values: dict[str, Any] = {}
    for line, assigned, expression in plain:
        try:
            known = {name: value for name, value in values.items() if name not in bound}
            value = _value_of(expression, known)
            if len(assigned) > 1 and not isinstance(value, int | float | str):
                raise ValueError("what can be changed in place may be changed under its other name")
            values |= dict.fromkeys([target.id for target in assigned], value)
        except (ValueError, ArithmeticError, TypeError):
            for target in assigned:
                if target.id in _USED:
                    raise _not_understood(path, line, target.id) from None
                values.pop(target.id, None)
    return values


def _check_encoding(text: str) -> None:
    """Raise ValueError if a line ``# coding: ...`` makes Python read another text than UTF-8 does."""
    raw = text.encode()
    encoding, _ = tokenize.detect_encoding(io.BytesIO(raw).readline)
    if raw.decode(encoding).removeprefix("\ufeff") != text.removeprefix("\ufeff"):
        raise ValueError(f"its encoding is {encoding}, expected utf-8")


def _plain_assignment(statement: ast.stmt) -> tuple[list[ast.Name], ast.expr]:
    """Return names and value of ``NAME = value`` or ``NAME: type = value``; no names for other statements."""
    if isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name) and statement.value:
        return [statement.target], statement.value
    if isinstance(statement, ast.Assign):
        names = [target for target in statement.targets if isinstance(target, ast.Name)]
        if len(names) == len(statement.targets):
            return names, statement.value
    return [], ast.Constant(None)


def _bound(part: ast.AST) -> list[str]:
    """Return the names that one node sets or deletes."""
    match part:
        case (
            ast.Name(id=name, ctx=ast.Store() | ast.Del())
            | ast.Attribute(attr=name, ctx=ast.Store() | ast.Del())
        ):
            return [name]
        case ast.alias():
            return [part.asname or part.name.partition(".")[0]]
        case ast.MatchMapping(rest=str(name)):
            return [name]
        case ast.FunctionDef() | ast.AsyncFunctionDef() | ast.ClassDef():
            return [part.name]
        case ast.ExceptHandler(name=str(name)) | ast.MatchAs(name=str(name)) | ast.MatchStar(name=str(name)):
            return [name]
    return []


def _mentioned(part: ast.AST) -> list[str]:
    match part:
        case ast.Name(id=name) | ast.Attribute(attr=name) | ast.alias(name=name):
            return [name]
    return []


def _value_of(node: ast.expr, known: Mapping[str, Any]) -> Any:
    """Evaluate literals, known names and arithmetic of numbers.

    Raises:
        ValueError: If there is anything else.
        ArithmeticError: If a division is by zero.
    """
    match node:
        case ast.Name(id=name):
            # What can be changed in place may be changed under another name.
            if isinstance(known.get(name), int | float | str):
                return known[name]
            raise ValueError(name)
        case ast.BinOp(left, op, right) if type(op) in _OPERATORS:
            numbers = _value_of(left, known), _value_of(right, known)
            if not all(isinstance(number, int | float) for number in numbers):
                raise ValueError(ast.unparse(node))
            return _OPERATORS[type(op)](*numbers)
        case ast.Dict(keys, values) if None not in keys:
            return {
                ast.literal_eval(key): _value_of(value, known)
                for key, value in zip(keys, values, strict=True)
                if key is not None
            }
    return ast.literal_eval(node)


def _not_understood(path: Path, line: int, name: str) -> ConfigError:
    return ConfigError(
        f"{path}, line {line}: {name!r}: this may change the car's pulses in a way that is not followed, "
        "since the file is not run; expected plain lines NAME = value"
    )


def settings_from_myconfig(path: Path) -> dict[str, Any]:
    """Return what a Donkeycar's files say about its PCA9685, as keys of :class:`PCA9685Settings`.

    ``config.py`` beside ``myconfig.py`` holds Donkeycar's defaults and is read first, as Donkeycar does.

    Args:
        path: ``myconfig.py``.

    Returns:
        Only what the files say.

    Raises:
        ConfigError: If a file is not Python or not only plain lines set the pulses, the car has no PCA9685,
            or a value is not of Donkeycar's type.
    """
    values: dict[str, Any] = {}
    base = path.with_name("config.py")
    if base.is_file() and base != path:
        values |= read_assignments(base)
    values |= read_assignments(path)
    train = values.get("DRIVE_TRAIN_TYPE", _SECTION)
    if train == _SECTION:
        section = values.get(train, {})
        if not isinstance(section, dict):
            raise ConfigError(f"{path}: {train}: expected a dictionary, found {section!r}")
        # Before Donkeycar 4.4 the same names stood at the top level.
        merged = {**{name: values[name] for name in _PULSES if name in values}, **section}
        # Products of its numbers may be infinite.
        with parsing(path, ConfigError):
            return {**_pulses(merged, path), **_pins(merged, path)}
    if train == "I2C_SERVO":
        places = {
            key: _whole(values, name, path)
            for name, key in _OLD_PLACES.items()
            if values.get(name) is not None
        }
        # Donkeycar has scales in its dictionary only.
        counts = {name: values[name] for name in _PULSES if name in values}
        with parsing(path, ConfigError):
            return {**_pulses(counts, path), **places}
    raise ConfigError(
        f"{path}: DRIVE_TRAIN_TYPE {train!r}, expected 'PWM_STEERING_THROTTLE' or 'I2C_SERVO': only a servo "
        "and a speed controller on a PCA9685 are supported"
    )


def with_myconfig(settings: PCA9685Settings) -> PCA9685Settings:
    """Fill unset settings from ``settings.myconfig``.

    Raises:
        ConfigError: If the file cannot be used, or its values are out of range.
    """
    if settings.myconfig is None:
        return settings
    said = settings.model_dump(exclude_unset=True)
    found = settings_from_myconfig(settings.myconfig.expanduser())
    return check_settings(PCA9685Settings, {**found, **said}, str(settings.myconfig))


def _pulses(values: dict[str, Any], path: Path) -> dict[str, float]:
    """Convert counts to pulse lengths at the chip's true rate."""
    count_us = 1e6 * (prescale_of(_FREQUENCY_HZ) + 1) / OSCILLATOR_HZ
    pulses = {}
    for name, key in _PULSES.items():
        if name not in values:
            continue
        scale = values.get("PWM_STEERING_SCALE" if name.startswith("STEERING") else "PWM_THROTTLE_SCALE", 1.0)
        count = values[name]
        for what, value in ((name, count), (f"scale of {name}", scale)):
            if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
                raise ConfigError(f"{path}: {what}: expected a number, found {value!r}")
        pulses[key] = round(int(count * scale) * count_us, 3)
    return pulses


def _pins(values: dict[str, Any], path: Path) -> dict[str, int]:
    places: dict[str, int] = {}
    for side in ("STEERING", "THROTTLE"):
        if values.get(f"PWM_{side}_INVERTED", False):
            raise ConfigError(
                f"{path}: PWM_{side}_INVERTED: found True, expected False: inverted signals are not supported"
            )
        name = f"PWM_{side}_PIN"
        if name not in values:
            continue
        match = _PIN.fullmatch(str(values[name]))
        if match is None:
            raise ConfigError(
                f"{path}: {name}: found {values[name]!r}, expected for example 'PCA9685.1:40.0'"
            )
        place = {"bus": int(match[1]), "address": int(match[2], 16)}
        for key, value in place.items():
            if places.setdefault(key, value) != value:
                raise ConfigError(f"{path}: steering and throttle are on two chips, expected one ({name})")
        places[f"{side.lower()}_channel"] = int(match[3])
    return places


def _whole(values: dict[str, Any], name: str, path: Path) -> int:
    value = values[name]
    if isinstance(value, bool) or not isinstance(value, int):
        raise ConfigError(f"{path}: {name}: expected a whole number, found {value!r}")
    return value
