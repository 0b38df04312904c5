"""The parts of a report's page."""

from __future__ import annotations

import numpy as np
import pytest

from lanenet.page import (
    Picture,
    as_sentence,
    bullets,
    colour_key,
    commands,
    details,
    gallery,
    page_of,
    photo,
    plot,
    remedy,
    table,
)

IMAGE = np.zeros((30, 1000, 3), np.uint8)


@pytest.mark.parametrize(
    ("grade", "colour"), [("good", "good"), ("usable", "usable"), ("refused", "reject"), ("", "told")]
)
def test_the_verdict_comes_first_in_the_colour_of_its_grade(grade: str, colour: str):
    page = page_of("Map <of> a & b", grade, "it lies here", [bullets([]), bullets(["one"])])
    assert "<title>Map &lt;of&gt; a &amp; b</title>" in page
    assert f'class="verdict {colour}"' in page and "<p>It lies here.</p>" in page
    assert page.index("It lies here.") < page.index("One.") and page.count("<ul") == 1
    assert (f"<strong>{grade}</strong>" in page) == bool(grade)


def test_nothing_to_say_leaves_no_trace():
    assert details("More", "", "") == remedy("") == gallery([]) == ""
    assert plot("No plot.", lambda: None) == ""


def test_without_matplotlib_a_plot_is_left_out():
    def draw() -> bytes:
        raise ImportError("Matplotlib is not installed")

    assert plot("The path.", draw) == ""
    assert "<figcaption>The path.</figcaption>" in plot("The path.", lambda: b"\x89PNG")


def test_a_picture_says_what_one_sees_also_to_those_who_do_not_see_it():
    shown = photo(Picture(IMAGE, 'frame 7: "near"'))
    assert shown.count("frame 7: &quot;near&quot;") == 2 and 'alt="frame 7' in shown


def test_small_pictures_take_few_bytes():
    rng = np.random.default_rng(0)
    large = Picture(rng.integers(0, 255, (600, 1000, 3), dtype=np.uint8), "noise")
    assert len(gallery([large])) < 0.5 * len(photo(large))


def test_options_are_not_broken_at_their_hyphens():
    assert "(<code>--camera</code>), or <code>--camera-height</code>." in remedy(
        "give (--camera), or --camera-height"
    )
    assert "<code>" not in remedy("a - b, well--known")


def test_command_lines_stand_apart_as_they_are_typed():
    text = commands([("lines without a camera", "lanenet detect 'my <tub>' --out a.csv")])
    expected = (
        "<p>Lines without a camera:</p><pre>lanenet detect &#x27;my &lt;tub&gt;&#x27; --out a.csv</pre>"
    )
    assert text == expected
    assert not commands([])


def test_text_columns_break_and_figures_do_not():
    shown = table([("a", "b"), ("<1>", "2")])
    assert "<th class=text>a</th><th>b</th>" in shown and "<td class=text>&lt;1&gt;</td><td>2</td>" in shown


def test_colours_are_those_of_the_picture():
    assert "background:#010203" in colour_key([((3, 2, 1), "the car")])


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("found 3 frames", "Found 3 frames."),
        ("closed.", "Closed."),
        ("camera.yaml: key 'fu' is missing", "camera.yaml: key 'fu' is missing."),
        ("runs/map is of another drive", "runs/map is of another drive."),
        ("", "."),
    ],
)
def test_a_sentence_begins_with_a_capital_letter_or_a_name(text, sentence):
    assert as_sentence(text) == sentence
