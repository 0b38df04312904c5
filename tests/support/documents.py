"""The project's documents: their links, headings and commands; and the verbs that there are."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import typer

from lanenet.cli.app import app

REPO = Path(__file__).resolve().parents[2]
#: What people read; results and model cards hold what commands wrote.
DOCUMENTS = tuple(
    REPO / name for name in ("README.md", "CONTRIBUTING.md", "checkpoints/README.md", "firmware/README.md")
) + tuple(path for path in sorted((REPO / "docs").rglob("*.md")) if "results" not in path.parts)
#: Documents with links, those that commands wrote as well.
LINKED = tuple(dict.fromkeys((*DOCUMENTS, *sorted((REPO / "docs").rglob("*.md")), *REPO.glob("*.md"))))
_BLOCK = re.compile(
    r"^(?P<fence>`{3,})(?P<language>\w*)[^\n]*\n(?P<text>.*?)^(?P=fence)$", re.MULTILINE | re.DOTALL
)


def _verbs(group: Any, prefix: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Walk through all verbs, those of groups (``calibrate chessboard``) by their full names.

    By attribute and not by class: typer stands on click or on a copy of it, by its version.
    """
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from _verbs(command, (*prefix, name))
        else:
            yield (*prefix, name), command


VERBS = dict(_verbs(typer.main.get_command(app)))


@dataclass(frozen=True)
class Command:
    """One command line of a document.

    Attributes:
        document: Its path in the project.
        line: The line without its comment.
    """

    document: str
    line: str

    @property
    def words(self) -> list[str]:
        """The words of the line, patterns unexpanded."""
        return shlex.split(self.line)


def prose(text: str) -> str:
    """The text without its fenced blocks and code."""
    return re.sub(r"`[^`\n]*`", "", _BLOCK.sub("", text))


def commands_of(document: Path) -> Iterator[Command]:
    """The command lines of a document's bash blocks; a backslash at the end joins two lines."""
    name = document.relative_to(REPO).as_posix()
    for block in _BLOCK.finditer(document.read_text(encoding="utf-8")):
        if block["language"] not in ("bash", "sh", "console"):
            continue
        for line in block["text"].replace("\\\n", " ").splitlines():
            words = " ".join(line.removeprefix("$ ").split())
            code = re.sub(r"(^|\s)#\s.*$", "", words).strip()
            if code:
                yield Command(name, code)


def unmarked_blocks(document: Path) -> list[str]:
    """Blocks that hold command lines without saying that they are ones."""
    text = document.read_text(encoding="utf-8")
    bare = [b["text"] for b in _BLOCK.finditer(text) if b["language"] not in ("bash", "sh", "console")]
    indented = re.findall(r"^ {4}[^\n]*$", _BLOCK.sub("", text), re.MULTILINE)
    return [
        line.strip()
        for part in (*bare, *indented)
        for line in part.splitlines()
        if re.match(r"\s*(\$ )?(lanenet (?!/)\w|make \w|pip install)", line)
    ]


def inline_commands(document: Path) -> list[str]:
    """Command lines within the text, as `lanenet VERB --option`; a line break is a space."""
    text = _BLOCK.sub("", document.read_text(encoding="utf-8"))
    spans = re.findall(r"`(lanenet [a-z][^`]*)`", text)
    return [" ".join(span.replace("\\|", "|").split()) for span in spans]


def links_of(text: str) -> list[str]:
    """The targets of links and images."""
    return re.findall(r"\]\(<?([^)\s>]+)>?(?:\s+\"[^\"]*\")?\)", prose(text))


def anchors_of(text: str) -> set[str]:
    """The anchors of a document's headings, as mkdocs and GitHub make them."""
    headings = re.findall(r"^#{1,6} +(.+?) *#*$", _BLOCK.sub("", text), re.MULTILINE)
    found: set[str] = set()
    for heading in headings:
        plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).replace("`", "").strip().lower()
        slug = re.sub(r"[\s]+", "-", re.sub(r"[^\w\s-]", "", plain))
        found.add(slug if slug not in found else f"{slug}_1")
    return found | set(re.findall(r"\{ *#([\w-]+)", text))
