"""The plain lines ``NAME = value`` of a Python file that is parsed and never run."""

from __future__ import annotations

import ast
import io
import operator
import tokenize
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lanenet.errors import ConfigError
from lanenet.reading import MEBIBYTE, read_text

#: Ways to change a variable without binding its name.
_UNFOLLOWED = {
    "*", "globals", "locals", "vars", "getattr", "setattr", "delattr", "exec", "eval", "__dict__",
    "__setattr__", "__globals__", "f_globals", "f_locals", "builtins", "__builtins__", "__import__",
    "__self__", "modules",
}  # fmt: skip
_OPERATORS: dict[type, Callable[[Any, Any], Any]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv,
    ast.FloorDiv: operator.floordiv,
}  # fmt: skip


@dataclass(frozen=True)
class Assignment:
    """The last value of a name, and the line that gives it.

    Attributes:
        value: As Python has it; of a dictionary, see ``entries``.
        path: The file.
        line: In the file, from 1.
        entries: The entries of a dictionary that is written out, by key.
    """

    value: Any
    path: Path
    line: int
    entries: dict[Any, Assignment] = field(default_factory=dict)

    @property
    def where(self) -> str:
        """File and line for an error."""
        return f"{self.path}, line {self.line}"


def read_assignments(path: Path, is_used: Callable[[str], bool], dictionary: str) -> dict[str, Assignment]:
    """Read the plain ``NAME = value`` lines of a Python file without running it.

    Values are literals, earlier names, and sums, differences, products and quotients of these. Others are
    left out. Later lines replace earlier ones.

    Args:
        path: The file.
        is_used: Tells the names whose values matter.
        dictionary: One of them, a dictionary, which changes under any other name, too.

    Raises:
        ConfigError: If the file is missing or is not Python; naming the line, if it sets or may change a name
            that is used in another way.
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
        names = [name for name in names if is_used(name)]
        if part not in targets:
            names += [name for name in _mentioned(part) if name in _UNFOLLOWED or name == dictionary]
        if names:
            raise _not_understood(path, getattr(part, "lineno", 0), names[0])
    found: dict[str, Assignment] = {}
    for line, assigned, expression in plain:
        try:
            known = {name: given.value for name, given in found.items() if name not in bound}
            value = _value_of(expression, known)
            if len(assigned) > 1 and not isinstance(value, int | float | str):
                raise ValueError("what can be changed in place may be changed under its other name")
            given = Assignment(value, path, line, _entries(expression, value, path))
            found |= dict.fromkeys([target.id for target in assigned], given)
        except (ValueError, ArithmeticError, TypeError):
            for target in assigned:
                if is_used(target.id):
                    raise _not_understood(path, line, target.id) from None
                found.pop(target.id, None)
    return found


def _entries(expression: ast.expr, value: Any, path: Path) -> dict[Any, Assignment]:
    """Return the entries of a dictionary with their lines; none for other values."""
    if not isinstance(expression, ast.Dict):
        return {}
    keys = [(ast.literal_eval(key), key.lineno) for key in expression.keys if key is not None]
    return {key: Assignment(value[key], path, line) for key, line in keys}


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
