"""The page of a report: one HTML file with its pictures in it, readable on a phone, in light and dark.

Each page begins with a sentence and holds one table; what only some readers want is folded. The style sheet
stands here and nowhere else.
"""

from __future__ import annotations

import base64
import html
import re
from collections.abc import Callable, Sequence
from string import Template
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import UInt8

#: The report in the folder of a map, a checkpoint or a contest.
PAGE_NAME = "report.html"
#: Width, [in], and resolution of a plot on a page. Chosen: letters are legible on a phone.
PLOT_WIDTH_IN, PLOT_DPI = 4.6, 160
#: Of a photograph; above it the bytes grow and the look does not. Chosen.
_JPEG_QUALITY = 85
#: Most pixels across a small picture. Chosen: two of them side by side fill a phone.
SMALL_PX = 480
#: What a verdict may say in one word; any other word is a refusal. Without a word it only tells.
_GRADES = ("good", "usable", "")

Row = Sequence[str]

_PAGE = Template(
    """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>$title</title>
<style>
:root{--ink:#1f2328;--soft:#59636e;--paper:#fff;--edge:#d8dee4;--card:#f6f8fa}
@media (prefers-color-scheme:dark){
:root{--ink:#e6e8eb;--soft:#9da7b1;--paper:#1a1a1a;--edge:#3d444d;--card:#242628}
/* White becomes the paper's colour, and hues stay. */
.plot img{filter:invert(.9) hue-rotate(180deg)}
}
*{box-sizing:border-box}
body{font:16px/1.5 system-ui,sans-serif;max-width:60rem;margin:0 auto;padding:0 1rem 3rem;
color:var(--ink);background:var(--paper);overflow-wrap:break-word}
h1{font-size:1.4rem;line-height:1.25;margin:1.2rem 0 .8rem}
h2{font-size:1.15rem;margin:2rem 0 .5rem}h3{font-size:1rem;margin:1.5rem 0 .4rem}
.verdict{padding:.8rem 1rem;border-radius:.5rem;color:#fff}
.verdict strong{font-size:1.3rem;text-transform:uppercase;letter-spacing:.03em}
.verdict p{margin:.2rem 0;font-size:1.1rem}
.good{background:#2e7d32}.usable{background:#9a5b00}.reject{background:#b3261e}.told{background:#1f5fa8}
.remedy{margin:.8rem 0;
border-left:.3rem solid #1f5fa8;background:var(--card);padding:.6rem 1rem;border-radius:.3rem}
.remedy p{margin:0}
figure{margin:1rem 0}img{max-width:100%;height:auto;display:block;border-radius:.25rem}
.plot{max-width:38rem}.plot img{border-radius:0}
figcaption,.note{color:var(--soft);font-size:.9rem;margin:.35rem 0}
.frames{display:grid;grid-template-columns:repeat(auto-fill,minmax(9.5rem,1fr));gap:.6rem}
.frames figure{margin:0}.frames img{width:100%}
.frames figcaption{font-size:.8rem;line-height:1.3;margin:.2rem 0}
.scroll{overflow-x:auto;margin:.8rem 0}table{border-collapse:collapse;font-size:.9rem}
td,th{padding:.3rem .4rem;border-bottom:1px solid var(--edge);text-align:right;white-space:nowrap;
vertical-align:top}
th{font-weight:600;white-space:normal;vertical-align:bottom}.text{text-align:left;white-space:normal;min-width:6rem}
td:first-child,th:first-child{padding-left:0}
@media (max-width:30rem){table{font-size:.8rem}td,th{padding:.3rem}.text{min-width:5rem}}
details{border-top:1px solid var(--edge);padding:.2rem 0}
details:last-of-type{border-bottom:1px solid var(--edge)}
summary{font-weight:600;cursor:pointer;padding:.5rem 0}
code{white-space:nowrap;font-size:.92em}
pre{white-space:pre-wrap;background:var(--card);padding:.6rem 1rem;border-radius:.3rem;font-size:.85rem}
ul{padding-left:1.2rem}li{margin:.3rem 0}
.key i{display:inline-block;width:.9em;height:.9em;border-radius:.2em;border:1px solid var(--soft);
vertical-align:-.1em;margin-right:.4em}
.key{list-style:none;padding:0;font-size:.9rem}
</style></head><body>
<h1>$title</h1>
<div class="verdict $colour">$grade<p>$sentence</p></div>
$body
</body></html>
"""
)


class Picture(NamedTuple):
    """A picture, BGR, and what one sees on it."""

    image: UInt8[np.ndarray, "h w 3"]
    caption: str


def page_of(title: str, grade: str, sentence: str, body: Sequence[str]) -> str:
    """Put a page together: title, verdict with its sentence, and the parts that are not empty.

    Args:
        title: What the page is about.
        grade: ``good``, ``usable``, another word for a refusal; "" where nothing is graded.
        sentence: The verdict.
        body: HTML of the parts.
    """
    colour = (grade or "told") if grade in _GRADES else "reject"
    return _PAGE.substitute(
        title=html.escape(title),
        grade=f"<strong>{html.escape(grade)}</strong>" if grade else "",
        colour=colour,
        sentence=_shown(as_sentence(sentence)),
        body="\n".join(part for part in body if part),
    )


def _shown(text: str) -> str:
    """Escape a text; what is typed into a terminal is not broken at its hyphens."""
    return re.sub(r"(?<!\S)(\(?)(--[a-z-]+)", r"\1<code>\2</code>", html.escape(text))


def as_sentence(text: str) -> str:
    """Begin with a capital letter, unless the first word is a file or a key, and end with a full stop."""
    name = re.match(r"\S*[./_]\S*\w", text)
    return (text[:1] if name else text[:1].upper()) + text[1:].rstrip(".") + "."


def section(title: str) -> str:
    """Head a section."""
    return f"<h2>{html.escape(title)}</h2>"


def subsection(title: str) -> str:
    """Head a part of a section."""
    return f"<h3>{html.escape(title)}</h3>"


def details(title: str, *parts: str) -> str:
    """Fold parts under a title; nothing if they are empty."""
    inside = "\n".join(part for part in parts if part)
    return f"<details><summary>{html.escape(title)}</summary>{inside}</details>" if inside else ""


def note(text: str) -> str:
    """Explain something in a paragraph."""
    return f'<p class="note">{_shown(text)}</p>'


def remedy(text: str) -> str:
    """Say what to do; nothing if that is not known."""
    said = f"<strong>What to do:</strong> {_shown(as_sentence(text))}"
    return f'<div class="remedy"><p>{said}</p></div>' if text else ""


def bullets(lines: Sequence[str]) -> str:
    """List sentences; nothing if there is none."""
    shown = "".join(f"<li>{_shown(as_sentence(line))}</li>" for line in lines)
    return f"<ul>{shown}</ul>" if lines else ""


def commands(lines: Sequence[tuple[str, str]]) -> str:
    """Show command lines to be copied, each below what it does."""
    return "\n".join(
        f"<p>{html.escape(as_sentence(what)[:-1])}:</p><pre>{html.escape(command)}</pre>"
        for what, command in lines
    )


def colour_key(entries: Sequence[tuple[tuple[int, int, int], str]]) -> str:
    """List what colours, BGR, stand for."""
    lines = (
        f'<li><i style="background:#{r:02x}{g:02x}{b:02x}"></i>{html.escape(text)}</li>'
        for (b, g, r), text in entries
    )
    return f'<ul class="key">{"".join(lines)}</ul>'


def table(rows: Sequence[Row], texts: int = 1) -> str:
    """Lay out rows; the first one is the header.

    Args:
        rows: Cells.
        texts: Columns, from the left, that are text, whose lines may break; the others are figures.
    """
    lines: list[str] = []
    for row in rows:
        tag = "td" if lines else "th"
        cells = (
            f"<{tag}{' class=text' if k < texts else ''}>{html.escape(cell)}</{tag}>"
            for k, cell in enumerate(row)
        )
        lines.append(f"<tr>{''.join(cells)}</tr>")
    return f'<div class="scroll"><table>{"".join(lines)}</table></div>'


def plot(caption: str, draw: Callable[..., bytes | None], *args: Any) -> str:
    """Show a plot, a PNG of :data:`PLOT_WIDTH_IN`; nothing where it is None or Matplotlib is missing."""
    try:
        png = draw(*args)
    except ImportError:
        return ""
    return "" if png is None else _figure(png, "png", caption, ' class="plot"')


def photo(picture: Picture) -> str:
    """Show a large picture."""
    return _figure(jpeg_bytes(picture.image), "jpeg", picture.caption)


def gallery(pictures: Sequence[Picture]) -> str:
    """Show small pictures side by side, as many as there is room for."""
    shown = "".join(photo(Picture(_small(image), caption)) for image, caption in pictures)
    return f'<div class="frames">{shown}</div>' if pictures else ""


def _small(image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h2 w2 3"]:
    factor = SMALL_PX / image.shape[1]
    if factor >= 1.0:
        return image
    return np.asarray(cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA))


def jpeg_bytes(image: UInt8[np.ndarray, "h w 3"]) -> bytes:
    """Encode a picture."""
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return bytes(data.tobytes())


def _figure(data: bytes, kind: str, caption: str, of_class: str = "") -> str:
    source = f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"
    text = html.escape(caption)
    return f'<figure{of_class}><img alt="{text}" src="{source}"><figcaption>{text}</figcaption></figure>'
