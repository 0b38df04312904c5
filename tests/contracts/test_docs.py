"""The documents: links lead somewhere, and the site has every page."""

from __future__ import annotations

import ast
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from documents import LINKED, REPO, VERBS, anchors_of, links_of

DOCS = REPO / "docs"


def name_of(path: Path) -> str:
    return path.relative_to(REPO).as_posix()


def broken_links(document: Path) -> list[str]:
    """Links of a document that lead to no file, or to no heading of it; addresses are left out."""
    broken = []
    for link in links_of(document.read_text(encoding="utf-8")):
        if re.match(r"[a-z]+:", link):
            continue
        path, _, anchor = link.partition("#")
        target = document if not path else document.parent / path
        if not target.exists() or (anchor and anchor not in anchors_of(target.read_text(encoding="utf-8"))):
            broken.append(link)
    return broken


@pytest.mark.parametrize("document", LINKED, ids=name_of)
def test_every_link_leads_to_a_file_and_a_heading(document: Path) -> None:
    assert not broken_links(document)


def test_a_broken_link_is_found(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(
        "# One `code` heading\n[a](#one-code-heading) [b](other.md) [c](#two)\n```\n[d](e.md)\n```\n"
    )
    assert broken_links(page) == ["other.md", "#two"]


def pages_of(entry: object) -> list[str]:
    if isinstance(entry, str):
        return [entry]
    parts = entry.values() if isinstance(entry, dict) else entry
    assert isinstance(parts, list) or hasattr(parts, "__iter__")
    return [page for part in parts for page in pages_of(part)]


def test_the_site_has_every_page() -> None:
    pages = pages_of(yaml.safe_load((REPO / "mkdocs.yml").read_text(encoding="utf-8"))["nav"])
    assert len(pages) == len(set(pages))
    assert set(pages) == {path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md")}


def test_the_site_fetches_nothing() -> None:
    """Neither when it is built nor when it is read: no fonts, scripts or styles of other hosts."""
    config = yaml.safe_load((REPO / "mkdocs.yml").read_text(encoding="utf-8"))
    assert config["theme"]["font"] is False
    assert "://" not in (DOCS / "style.css").read_text(encoding="utf-8")
    for key in ("extra_css", "extra_javascript"):
        assert not [value for value in config.get(key, []) if "://" in value]
    for page in DOCS.rglob("*.md"):
        assert not re.search(
            r"!\[[^\]]*\]\(https?:|<(script|iframe|link)\b", page.read_text(encoding="utf-8")
        ), page


def messages_of_the_code() -> list[str]:
    """All texts in the code, with … for what is filled in."""
    texts = []
    for path in (*(REPO / "lanenet").rglob("*.py"), *(REPO / "datagen").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.JoinedStr):
                texts.append(
                    "".join(str(p.value) if isinstance(p, ast.Constant) else "…" for p in node.values)
                )
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                texts.append(node.value)
    return texts


def is_said(message: str, texts: list[str]) -> bool:
    """Whether the parts of a message stand in one text of the code in this order."""
    parts = [re.escape(part.strip()) for part in message.split("…") if part.strip(" .:;,'")]
    pattern = re.compile(".*?".join(parts), re.DOTALL)
    return bool(parts) and any(pattern.search(text) for text in texts)


def test_the_messages_of_troubleshooting_are_those_of_the_code() -> None:
    page = (DOCS / "troubleshooting.md").read_text(encoding="utf-8").partition("## By message")[2]
    messages = re.findall(r"^\| `([^`]+)` \|", page, re.MULTILINE)
    texts = messages_of_the_code()
    assert len(messages) > 50
    assert [message for message in messages if not is_said(message, texts)] == []
    assert not is_said("the car … flies", texts)


def test_the_drawings_are_those_of_the_code(tmp_path: Path) -> None:
    script = REPO / "contrib" / "docs" / "figures.py"
    subprocess.run([sys.executable, script, tmp_path], check=True, timeout=120)
    kept = sorted((DOCS / "images" / "frames").glob("*.svg"))
    assert [path.name for path in kept] == sorted(path.name for path in tmp_path.iterdir())
    for path in kept:
        drawn, shown = (
            (folder / path.name).read_text(encoding="utf-8") for folder in (tmp_path, path.parent)
        )
        # Versions of Matplotlib differ in how they round.
        assert re.findall(r">([^<\n]+)<", drawn) == re.findall(r">([^<\n]+)<", shown), path.name


REFERENCE = runpy.run_path(str(REPO / "contrib" / "docs" / "reference.py"))


def test_the_reference_has_every_option_with_its_meaning() -> None:
    page = REFERENCE["options_page"]()
    for names, command in VERBS.items():
        (part,) = re.findall(rf"^### {' '.join(names)}\n(.*?)(?=^##|\Z)", page, re.MULTILINE | re.DOTALL)
        rows = dict(re.findall(r"^\| (`[^|]*`) \| ([^|]*?) \|", part, re.MULTILINE))
        told = " ".join(rows)
        for parameter in command.params:
            if parameter.param_type_name == "option" and not parameter.hidden:
                assert f"`{parameter.opts[0]}" in told, f"{names}: {parameter.opts[0]}"
        assert all(rows.values()), names


def test_the_reference_has_every_setting_with_its_meaning() -> None:
    page = REFERENCE["settings_page"]()
    rows = re.findall(r"^\| `(\w+)` \| ([^|]*) \| ([^|]*) \| ([^|]*) \|", page, re.MULTILINE)
    assert len(rows) > 250
    assert [key for key, value, _, meaning in rows if not meaning.strip() or not value.strip()] == []
    # Nothing of Python that a YAML file does not know.
    assert not [row for row in rows if re.search(r"<|\(|Undefined|typing", " ".join(row[1:3]))]
    assert "| `epochs` | whole number, ≥ 1 | `12` |" in page
