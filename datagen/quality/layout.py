"""How the pages of a report are laid out: one self-contained HTML file, readable on a phone."""

from __future__ import annotations

import base64
import html
from collections.abc import Callable, Sequence
from string import Template
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

#: The report in a map's folder.
PAGE_NAME = "report.html"

Row = tuple[str, ...]

_PAGE = Template(
    """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>$title</title>
<style>
body{font:16px/1.45 system-ui,sans-serif;max-width:60rem;margin:0 auto;padding:0 1rem 3rem;color:#222}
h1{font-size:1.4rem}h2{font-size:1.15rem;margin-top:2rem;border-bottom:1px solid #ddd}
img{max-width:100%;height:auto;display:block;margin:.5rem 0}
.verdict{padding:.6rem 1rem;border-radius:.5rem;color:#fff}
.verdict strong{font-size:1.5rem;text-transform:uppercase}.verdict p{margin:.3rem 0;font-size:1.1rem}
.good{background:#2e7d32}.usable{background:#b26a00}.reject{background:#b71c1c}
.scroll{overflow-x:auto}table{border-collapse:collapse;font-size:.9rem}
td,th{padding:.25rem .6rem;border-bottom:1px solid #ddd;text-align:right;white-space:nowrap}
td:first-child,th:first-child{text-align:left;white-space:normal}
p.note{color:#555;font-size:.9rem}
</style></head><body>
<h1>$title</h1>
<div class="verdict $colour"><strong>$grade</strong><p>$sentence</p></div>
$body
</body></html>
"""
)


def page_of(title: str, grade: str, sentence: str, body: Sequence[str]) -> str:
    """Put a page together: title, verdict with its sentence, and the sections that are not empty."""
    return _PAGE.substitute(
        title=html.escape(title),
        grade=html.escape(grade),
        colour=grade if grade in ("good", "usable") else "reject",
        sentence=html.escape(sentence[:1].upper() + sentence[1:] + "."),
        body="\n".join(part for part in body if part),
    )


def section(title: str) -> str:
    """Head a section."""
    return f"<h2>{html.escape(title)}</h2>"


def note(text: str) -> str:
    """Explain something in a paragraph."""
    return f'<p class="note">{html.escape(text)}</p>'


def bullets(lines: Sequence[str]) -> str:
    """List sentences; nothing if there is none."""
    return "<ul>" + "".join(f"<li>{html.escape(line)}</li>" for line in lines) + "</ul>" if lines else ""


def table(rows: list[Row]) -> str:
    """Lay out rows of text; the first row is the header."""
    head, *rest = ("".join(f"<T>{html.escape(cell)}</T>" for cell in row) for row in rows)
    lines = [head.replace("T>", "th>"), *(row.replace("T>", "td>") for row in rest)]
    return '<div class="scroll"><table>' + "".join(f"<tr>{line}</tr>" for line in lines) + "</table></div>"


def plot(draw: Callable[..., bytes | None], *args: Any) -> str:
    """Inline a plot; nothing without Matplotlib."""
    try:
        png = draw(*args)
    except ImportError:
        return ""
    return "" if png is None else _inline(png, "png")


def jpeg(image: UInt8[np.ndarray, "h w 3"]) -> str:
    """Inline a picture."""
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 82])
    return _inline(data.tobytes(), "jpeg")


def _inline(data: bytes, kind: str) -> str:
    return f'<img alt="" src="data:image/{kind};base64,{base64.b64encode(data).decode("ascii")}">'
