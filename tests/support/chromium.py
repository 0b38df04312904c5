"""Pages in headless Chromium: what a reader's screen shows of them."""

from __future__ import annotations

import html
import json
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import pytest

#: Of a phone, [px].
PHONE_PX = 390

_NAMES = ("chromium", "chromium-browser", "google-chrome")
#: Loads a page in a frame as wide as a phone: Chromium's own windows are at least 500 px wide. Measures it as
#: it opens, and again with all that is folded opened.
_WRAPPER = """<!DOCTYPE html><meta charset="utf-8"><meta name="color-scheme" content="light dark">
<iframe id="phone" style="border:0;width:{width}px;height:900px" srcdoc="{page}"></iframe>
<pre id="seen"></pre>
<script>
addEventListener("load", () => {{
  const view = document.getElementById("phone").contentWindow, page = view.document
  const across = () => page.documentElement.scrollWidth
  const seen = {{width_px: view.innerWidth, folded_px: across()}}
  seen.height_px = page.documentElement.scrollHeight
  page.querySelectorAll("details").forEach(part => part.open = true)
  seen.opened_px = across()
  seen.figures = [...page.images].map(image => {{
    const box = image.getBoundingClientRect(), figure = image.closest("figure")
    return {{natural_px: image.complete ? image.naturalWidth : 0, left_px: box.left, right_px: box.right,
             caption: figure ? figure.querySelector("figcaption").innerText : ""}}
  }})
  const style = view.getComputedStyle(page.body)
  seen.paper = style.backgroundColor
  seen.ink = style.color
  seen.first = page.querySelector("h1").nextElementSibling.innerText
  seen.fetched = view.performance.getEntriesByType("resource").map(entry => entry.name.slice(0, 60))
    .filter(name => !name.startsWith("data:"))
  document.getElementById("seen").textContent = JSON.stringify(seen)
}})
</script>
"""


@dataclass(frozen=True)
class Figure:
    """A picture on a page: its own width, where it lies on the screen, and what it says, [px]."""

    natural_px: int
    left_px: float
    right_px: float
    caption: str


@dataclass(frozen=True)
class Seen:
    """What a phone shows of a page.

    Attributes:
        width_px: Of the screen.
        folded_px, opened_px: Of all that is on the page, as it opens and with all details opened.
        height_px: Of the page as it opens.
        figures: All pictures, those in details, too.
        paper, ink: Colour of the page and of its letters, 0 (black) to 255.
        first: Text of what follows the title.
        fetched: Addresses that the page asked for.
    """

    width_px: int
    folded_px: int
    opened_px: int
    height_px: int
    figures: tuple[Figure, ...]
    paper: int
    ink: int
    first: str
    fetched: tuple[str, ...]


def see(page: Path, folder: Path, dark: bool) -> Seen:
    """Open a page on a phone; skips the test where there is no Chromium."""
    wrapper = folder / f"{page.stem}-on-phone.html"
    text = html.escape(page.read_text(encoding="utf-8"))
    wrapper.write_text(_WRAPPER.format(width=PHONE_PX, page=text), encoding="utf-8")
    dumped = _chromium(folder, dark, "--virtual-time-budget=10000", "--dump-dom", wrapper.resolve().as_uri())
    seen = json.loads(html.unescape(dumped.rpartition('<pre id="seen">')[2].partition("</pre>")[0]))
    return Seen(
        **{name: seen[name] for name in ("width_px", "folded_px", "opened_px", "height_px", "first")},
        figures=tuple(Figure(**figure) for figure in seen["figures"]),
        paper=_gray(seen["paper"]),
        ink=_gray(seen["ink"]),
        fetched=tuple(seen["fetched"]),
    )


def take_screenshot(page: Path, png: Path, folder: Path, dark: bool, height_px: int) -> None:
    """Write what a phone shows of a page, down to a height."""
    size = f"--window-size={PHONE_PX},{height_px}"
    _chromium(folder, dark, size, f"--screenshot={png.resolve()}", page.resolve().as_uri())


def _gray(colour: str) -> int:
    """Mean of the channels of "rgb(1, 2, 3)"."""
    channels = [int(part) for part in colour.removeprefix("rgb(").removesuffix(")").split(",")]
    return sum(channels) // len(channels)


def _chromium(folder: Path, dark: bool, *arguments: str) -> str:
    program = next((found for name in _NAMES if (found := shutil.which(name))), None)
    if program is None:
        pytest.skip(f"none of {', '.join(_NAMES)} is installed: pages are not looked at")
    # Blink's setting: 0 is dark, 1 is light.
    scheme = f"--blink-settings=preferredColorScheme={0 if dark else 1}"
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", scheme]
    options.append(f"--user-data-dir={folder / 'chromium'}")
    done = subprocess.run(
        [program, *options, *arguments], capture_output=True, text=True, timeout=180.0, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout
