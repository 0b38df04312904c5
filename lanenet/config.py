"""Strict, typed settings read from YAML.

Every schema derives from :class:`Settings`: frozen, and unknown keys are refused. A YAML file lists only what
differs from the defaults; ``key=value`` overrides come last.

Values are as strict as keys: a number is a number, not ``yes``, a text or ``1:30``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, TypeVar, get_args

import yaml
from pydantic import BaseModel, ConfigDict, GetCoreSchemaHandler, ValidationError, model_validator
from pydantic_core import PydanticCustomError

from lanenet.errors import ConfigError, LanenetError, did_you_mean
from lanenet.reading import MEBIBYTE, parsing, read_text

#: Of a file of settings. Chosen: the largest one here has 11 kB.
_MAX_YAML = MEBIBYTE
#: Values of a file, with every alias written out: nine aliases of nine aliases, nine times over, are 400
#: million. Chosen: far above what a person writes; PyYAML reads that many in half a second.
_MAX_NODES = 10_000


def _with_strict_numbers(schema: Any) -> Any:
    # pydantic's own strict mode would refuse lists for tuples and texts for paths, too.
    if isinstance(schema, list | tuple):
        return type(schema)(_with_strict_numbers(item) for item in schema)
    if not isinstance(schema, dict):
        return schema
    strict = {"strict": True} if schema.get("type") in ("bool", "float", "int") else {}
    kept = ("default", "expected", "metadata")
    return {k: v if k in kept else _with_strict_numbers(v) for k, v in schema.items()} | strict


@dataclass(frozen=True)
class Rule:
    """Settings that constrain each other, in the section to which all of them belong.

    Attributes:
        keys: Their dotted keys in this section. A rule does not apply where a section on the way is missing.
        holds: Whether the section's values can be right.
        expected: What would be, for the error, which shows keys and values itself.
    """

    keys: tuple[str, ...]
    holds: Callable[[Any], bool]
    expected: Callable[[Any], str]


class Settings(BaseModel):
    """Base of every settings schema.

    Attributes:
        rules: Of this section; those of the sections in it are their own.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, validate_default=True)

    rules: ClassVar[tuple[Rule, ...]] = ()

    def open_keys(self) -> frozenset[str]:
        """Return the keys whose values come later, from elsewhere; their rules wait for them."""
        return frozenset()

    @model_validator(mode="after")
    def _check_rules(self) -> Settings:
        """Report every rule that does not hold at once: mending one value may take another."""
        later, broken = self.open_keys(), []
        for rule in self.rules:
            values = [_value_at(self, key) for key in rule.keys]
            if (
                not any(value is _ABSENT for value in values)
                and later.isdisjoint(rule.keys)
                and not rule.holds(self)
            ):
                broken.append((rule.keys, values, rule.expected(self)))
        if broken:
            raise PydanticCustomError("rules", "settings that cannot be right", {"broken": broken})
        return self

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: GetCoreSchemaHandler) -> Any:
        """Take numbers only for numbers, and truth values only for truth values."""
        return _with_strict_numbers(handler(source))


SettingsT = TypeVar("SettingsT", bound=Settings)

_ABSENT = object()


def _value_at(section: Any, key: str) -> Any:
    """Return the value of a dotted key; ``_ABSENT`` where one of its sections is missing."""
    for part in key.split("."):
        section = getattr(section, part, _ABSENT)
    return section


def flat_settings(settings: Settings) -> dict[str, Any]:
    """Return all values by their dotted keys, such as ``edges.blur_px``."""
    flat: dict[str, Any] = {}
    for key, value in settings:
        if isinstance(value, Settings):
            flat |= {f"{key}.{inner}": v for inner, v in flat_settings(value).items()}
        else:
            flat[key] = value
    return flat


class _Loader(yaml.SafeLoader):
    """YAML with the numbers of version 1.2, and without keys that occur twice.

    In YAML 1.1 ``1:30`` is 90, ``010`` is 8, ``1_0`` is 10 and ``1e-3`` is a text.
    """

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._nodes = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Count the values before they are built."""
        self._nodes += 1
        if self._nodes > _MAX_NODES:
            raise yaml.composer.ComposerError(problem=f"more than {_MAX_NODES} values")
        return super().compose_node(parent, index)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Refuse what PyYAML takes: the last of several values."""
        lines: dict[str, int] = {}
        for key, _ in node.value:
            line = key.start_mark.line + 1
            if key.value == "<<" or not isinstance(key, yaml.ScalarNode):
                continue
            if key.value in lines:
                problem = f"key {key.value!r} occurs twice, first at line {lines[key.value]}"
                raise yaml.constructor.ConstructorError(problem=problem, problem_mark=key.start_mark)
            lines[key.value] = line
        return super().construct_mapping(node, deep)


_INT, _FLOAT = "tag:yaml.org,2002:int", "tag:yaml.org,2002:float"
_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in known if tag not in (_INT, _FLOAT)]
    for first, known in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_Loader.add_implicit_resolver(
    _INT, re.compile(r"[-+]?(0|[1-9][0-9]*)$|0x[0-9a-fA-F]+$"), list("-+0123456789")
)
_Loader.add_implicit_resolver(
    _FLOAT,
    re.compile(
        r"[-+]?(\.[0-9]+|(0|[1-9][0-9]*)(\.[0-9]*)?)([eE][-+]?[0-9]+)?$|[-+]?\.(inf|Inf|INF)$|\.(nan|NaN|NAN)$"
    ),
    list("-+.0123456789"),
)
_Loader.add_constructor(_INT, lambda _, node: int(str(node.value), 0))


def parse_yaml(text: str, where: object, error: type[LanenetError] = ConfigError) -> Any:
    """Return the plain data of a YAML text.

    Raises:
        LanenetError: Of the type ``error``, naming ``where`` and the line, if it is not YAML, a key occurs
            twice, or its aliases would fill the memory.
    """
    with parsing(f"{where}: not valid YAML", error):
        try:
            loader = _Loader(text)
            node = loader.get_single_node()
            if node is None:
                return None
            if _count_nodes(node, {}) > _MAX_NODES:
                raise error(f"{where}: its aliases stand for more than {_MAX_NODES} values")
            return loader.construct_document(node)
        except yaml.YAMLError as problem:
            mark = getattr(problem, "problem_mark", None)
            line = f" at line {mark.line + 1}" if mark is not None else ""
            why = getattr(problem, "problem", None) or getattr(problem, "reason", None)
            raise error(f"{where}: not valid YAML{line}{f' ({why})' if why else ''}") from None


def _count_nodes(node: yaml.Node, known: dict[int, int]) -> int:
    """Count the values below a node; one that stands within itself counts as too many."""
    if isinstance(node, yaml.ScalarNode):
        return 1
    if id(node) not in known:
        known[id(node)] = _MAX_NODES + 1
        parts = (
            node.value if isinstance(node, yaml.SequenceNode) else [p for pair in node.value for p in pair]
        )
        known[id(node)] = 1 + sum(_count_nodes(part, known) for part in parts)
    return known[id(node)]


def read_yaml(path: Path, error: type[LanenetError] = ConfigError) -> dict[str, Any]:
    """Read a YAML file whose top level is a mapping.

    Raises:
        LanenetError: Of the type ``error``, if the file is missing, is not YAML, or is not a mapping.
    """
    data = parse_yaml(read_text(path, error, _MAX_YAML), path, error)
    if data is None:
        return {}
    if not isinstance(data, dict):
        raise error(f"{path}: expected a mapping of keys to values, found {type(data).__name__}")
    return data


def apply_overrides(data: dict[str, Any], overrides: list[str]) -> dict[str, Any]:
    """Return ``data`` with ``a.b=value`` overrides applied; values are parsed as YAML.

    Entries of a list are counted from 0: ``drives.0.split=lap``.

    Raises:
        ConfigError: If an override has no ``=`` or goes through a key that is neither a mapping nor a list.
    """
    result = dict(data)
    for override in overrides:
        key, equals, text = override.partition("=")
        if not equals or not key:
            raise ConfigError(f"override {override!r}: expected key=value")
        value = parse_yaml(text, f"override {override!r}")
        *parents, last = key.split(".")
        node: Any = result
        for parent in parents:
            at = _entry(node, parent, override)
            child = node.get(at, {}) if isinstance(node, dict) else node[at]
            if not isinstance(child, dict | list):
                raise ConfigError(f"override {override!r}: {parent} is not a section")
            node[at] = list(child) if isinstance(child, list) else dict(child)
            node = node[at]
        node[_entry(node, last, override)] = value
    return result


def _entry(node: dict[str, Any] | list[Any], key: str, override: str) -> Any:
    """Return a key of a mapping, or the number of an entry of a list."""
    if isinstance(node, dict):
        return key
    if not key.isdecimal() or int(key) >= len(node):
        raise ConfigError(f"override {override!r}: {key} is no entry of a list of {len(node)}, from 0")
    return int(key)


def load_settings(schema: type[SettingsT], path: Path, overrides: list[str] | None = None) -> SettingsT:
    """Read ``path``, apply overrides and check the result against ``schema``.

    Raises:
        ConfigError: Naming the file and the overrides, the key, what was found and what was expected.
    """
    where = " ".join([str(path), *(overrides or [])])
    return check_settings(schema, apply_overrides(read_yaml(path), overrides or []), where)


def check_settings(schema: type[SettingsT], data: dict[str, Any], where: str) -> SettingsT:
    """Check plain data against a schema; ``where`` is its origin, for the error.

    Raises:
        ConfigError: Naming the origin, the key, what was found and what was expected.
    """
    with parsing(where, ConfigError):
        try:
            return schema.model_validate(data)
        except ValidationError as error:
            raise ConfigError(
                f"{where}: " + "; ".join(_describe(schema, e) for e in error.errors()[:3])
            ) from None


def dump_settings(settings: Settings) -> str:
    """Return the settings as YAML, with every key."""
    return to_yaml(settings.model_dump(mode="json"))


def to_yaml(data: dict[str, Any]) -> str:
    """Return plain values as YAML, in their order."""
    return yaml.safe_dump(data, sort_keys=False, allow_unicode=True)


def _describe(schema: type[BaseModel], error: Any) -> str:
    location, _ = _place(schema, error["loc"])
    key = ".".join(location) or "(top level)"
    if error["type"] == "rules":
        return "; ".join(_describe_rule(location, *broken) for broken in error["ctx"]["broken"])
    if error["type"] == "extra_forbidden":
        _, sections = _place(schema, error["loc"][:-1])
        known = [name for section in sections for name in section.model_fields]
        hint = did_you_mean(location[-1], known) or f", known keys: {', '.join(sorted(known))}"
        return f"unknown key {key!r}{hint}"
    if error["type"] == "missing":
        return f"key {key!r} is missing"
    found = error.get("input")
    shown = "NaN" if isinstance(found, float) and math.isnan(found) else repr(found)
    message = error["msg"].removeprefix("Value error, ")
    message = message[:1].lower() + message[1:]
    return f"key {key!r}: {message}, found {shown[:80]}"


def _describe_rule(location: list[str], keys: tuple[str, ...], values: list[Any], expected: str) -> str:
    *first, last = [
        f"{'.'.join([*location, key])}={_shown(value)}" for key, value in zip(keys, values, strict=True)
    ]
    return f"found {', '.join(first)}{' and ' if first else ''}{last}: {expected}"


def _shown(value: Any) -> str:
    """Return a value as a file or an override has it."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return f"{value:g}" if isinstance(value, float) else str(value)


def _place(schema: type[BaseModel], location: Sequence[str | int]) -> tuple[list[str], list[type[BaseModel]]]:
    """Return the keys of an error as the file has them, and the schemas of the section at their end.

    pydantic's own location holds the ``kind`` as well by which it tells one section from another.
    """
    keys: list[str] = []
    models = [schema]
    for part in map(str, location):
        fields = [model.model_fields[part].annotation for model in models if part in model.model_fields]
        of_kind = [m for m in models if "kind" in m.model_fields and m.model_fields["kind"].default == part]
        if of_kind and not fields:
            models = of_kind
            continue
        keys.append(part)
        # The number of an entry of a list is no field.
        models = [model for field in fields for model in models_in(field)] if fields else models
    return keys, models


def models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    """Yield the schemas of a field's type: one, or several that the section's ``kind`` chooses from."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for part in get_args(annotation):
        yield from models_in(part)
