"""The leaderboard by left-out track: ``make leaderboard``.

Nothing is measured here: the figures are those of ``make left-out``, from the table in its folder where that
is there, and else from its page, which has them with two digits. The conditions are those of the page.
"""

from __future__ import annotations

import argparse
import csv
import math
import re
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from lanenet.data.files import write_text
from lanenet.errors import LanenetError
from lanenet.evaluation.tables import TextTable, show_cm, show_share

#: The network that has not seen the track, and the one that has seen nothing real: names in the table.
WITHOUT, SYNTHETIC = "left out", "start"
NAMES = {WITHOUT: "network, without this track", SYNTHETIC: "network, simulated drives only"}
_WEIGHTS = re.compile(r"\(weights ([0-9a-f]{8})\)")
_SHARED = "Whole drives that were left out: the points that both answer, in cm"
_ALL = "Whole drives that were left out: all labelled points, in cm"


@dataclass(frozen=True)
class Figures:
    """Errors on some points, [cm], and the share of the labelled points that these are."""

    share: float
    rmse_cm: float
    median_cm: float
    p95_cm: float


@dataclass(frozen=True)
class Result:
    """What was measured of a detector on a track.

    Attributes:
        track: The drive that was left out.
        detector: ``WITHOUT``, ``SYNTHETIC`` or a classical detector.
        answered: On all labelled points that it answers.
        shared: On those that it and ``WITHOUT`` answer; None for the networks.
        network: Errors of ``WITHOUT`` on the same points; None for the networks.
    """

    track: str
    detector: str
    answered: Figures
    shared: Figures | None = None
    network: Figures | None = None


def results_of_table(path: Path, start: str) -> list[Result]:
    """Read the table of ``make left-out``; ``start`` is the hash of the weights that all started from."""
    with path.open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["start"] == start and row["rows"] == "all"]

    def figures(row: dict[str, str], prefix: str, share: str) -> Figures:
        return Figures(
            float(row[share]), *(float(row[f"{prefix}{name}_cm"]) for name in ("rmse", "median", "p95"))
        )

    found = []
    for row in rows:
        is_network = row["detector"] == "network"
        if is_network and row["what"] in NAMES:
            found.append(Result(row["drive"], row["what"], figures(row, "", "answered")))
        elif not is_network and row["what"] == WITHOUT:
            shared = (figures(row, prefix, "shared") for prefix in ("shared_", "network_"))
            found.append(Result(row["drive"], row["detector"], figures(row, "", "answered"), *shared))
    return found


def results_of_page(text: str) -> list[Result]:
    """Read the same from the page, ``docs/results/left-out.md``.

    Raises:
        LanenetError: If it has no such tables.
    """
    pairs = {}
    for row in _rows_of(text, _SHARED):
        if row["network"] == WITHOUT and row["rows"] == "all":
            both = [
                Figures(
                    _number(row["shared"]),
                    *(_number(row[f"{name}: {who}"]) for name in ("RMSE", "median", "p95")),
                )
                for who in ("detector", "network")
            ]
            pairs[row["drive"], row["detector"]] = both
    found = []
    for row in _rows_of(text, _ALL):
        detector = row["detector"].removeprefix("network, ")
        answered = Figures(*(_number(row[name]) for name in ("answered", "RMSE", "median", "p95")))
        found.append(Result(row["drive"], detector, answered, *pairs.get((row["drive"], detector), ())))
    return found


def _rows_of(text: str, title: str) -> Iterable[dict[str, str]]:
    """Rows of the Markdown table below a title."""
    _, found, rest = text.partition(f"\n{title}\n\n")
    lines = rest.split("\n\n", 1)[0].splitlines()
    if not found or len(lines) < 3:
        raise LanenetError(f"expected the table {title!r} of make left-out")
    header, _, *rows = ([cell.strip() for cell in line.strip("|").split("|")] for line in lines)
    return [dict(zip(header, row, strict=True)) for row in rows]


def _number(cell: str) -> float:
    """Read a cell; NaN where nothing was answered."""
    if cell == "-":
        return math.nan
    return float(cell.rstrip("%")) / 100.0 if cell.endswith("%") else float(cell)


def times_worse(result: Result, without: Result) -> float:
    """Return the RMSE of a detector over that of the network which has not seen the track, both on one set.

    That is, on the points that both answer: a detector that is silent where it is hard would win otherwise.
    The networks answer nearly all points; for them all that each answers counts.
    """
    if result.shared is None or result.network is None:
        return result.answered.rmse_cm / without.answered.rmse_cm
    return result.shared.rmse_cm / result.network.rmse_cm


def leaderboard(results: Sequence[Result]) -> list[TextTable]:
    """Lay out the tracks together, and each one ranked."""
    tracks = sorted({result.track for result in results})
    ratios: dict[str, dict[str, float]] = {}
    tables = []
    for track in tracks:
        here = [result for result in results if result.track == track]
        without = next(result for result in here if result.detector == WITHOUT)
        for result in here:
            ratios.setdefault(result.detector, {})[track] = times_worse(result, without)
        here.sort(key=lambda result: _last_if_unknown(ratios[result.detector][track]))
        lines = [
            _line(rank, result, ratios[result.detector][track]) for rank, result in enumerate(here, start=1)
        ]
        header = ["rank", "detector", "times the network", "answered", "RMSE", "median", "p95", "shared"]
        header += [
            f"{name}, shared: {who}" for name in ("RMSE", "median", "p95") for who in ("own", "network")
        ]
        note = (
            "shared: the points that it and the network without this track both answer, of all labelled ones"
        )
        tables.append(TextTable(f"## {track}, in cm", header, lines, note, texts=2))
    # Over tracks, ratios are averaged by their logarithms.
    means = {}
    for name, by_track in ratios.items():
        known = [times for times in by_track.values() if not math.isnan(times)]
        if len(by_track) == len(tracks) and known:
            means[name] = math.exp(sum(map(math.log, known)) / len(known))
    lines = [
        [str(rank), NAMES.get(name, name), f"{means[name]:.2f}", *(_ratio(ratios[name][t]) for t in tracks)]
        for rank, name in enumerate(sorted(means, key=lambda name: means[name]), start=1)
    ]
    note = (
        "RMSE over that of the network without the track, on the points that both answer; mean: geometric, "
        "of the tracks on which there are such points"
    )
    return [
        TextTable("## All tracks", ["rank", "detector", "mean", *tracks], lines, note, texts=2),
        *tables,
    ]


def _last_if_unknown(times: float) -> float:
    return math.inf if math.isnan(times) else times


def _ratio(times: float) -> str:
    return "-" if math.isnan(times) else f"{times:.2f}"


def _line(rank: int, result: Result, times: float) -> list[str]:
    cells = [str(rank), NAMES.get(result.detector, result.detector), _ratio(times)]
    own = result.answered
    cells += [show_share(own.share), *map(show_cm, (own.rmse_cm, own.median_cm, own.p95_cm))]
    if result.shared is None or result.network is None:
        return cells + ["-"] * 7
    cells.append(show_share(result.shared.share))
    for name in ("rmse_cm", "median_cm", "p95_cm"):
        cells += [show_cm(getattr(result.shared, name)), show_cm(getattr(result.network, name))]
    return cells


def report(page: str, table: Path) -> str:
    """Write the leaderboard from the page of ``make left-out`` and, where it is there, its table.

    Raises:
        LanenetError: If the page is not one of ``make left-out``.
    """
    weights = _WEIGHTS.search(page)
    if weights is None:
        raise LanenetError("expected a page of make left-out, which names the weights that it started from")
    results = results_of_table(table, weights[1]) if table.is_file() else []
    source = "the table that `make left-out` keeps"
    if not results:
        results, source = results_of_page(page), "the page [left-out.md](left-out.md), with its two digits"
    # From the conditions of the page to its first table, with the drives that could not be tested.
    conditions = page[page.index("Conditions: ") : page.index(_ALL)].strip()
    head = [
        "# Leaderboard by left-out track",
        f"Command: `make leaderboard`. Derived from {source}; nothing was measured anew.",
        conditions,
        "Ranked by the RMSE over that of the network which has not seen the track, on the points that both "
        "answer: whoever is silent where it is hard gains nothing by it. Between the two networks all that "
        "each answers counts.",
    ]
    return "\n\n".join([*head, *(table.as_markdown() for table in leaderboard(results))])


def main() -> None:
    """Write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, default=Path("runs/left-out"), help="of make left-out")
    parser.add_argument("--page", type=Path, default=Path("docs/results/left-out.md"))
    parser.add_argument("--out", type=Path, default=Path("docs/results/leaderboard.md"))
    args = parser.parse_args()
    write_text(args.out, report(args.page.read_text(encoding="utf-8"), args.folder / "left-out.csv"))
    sys.stdout.write(f"wrote {args.out}\n")


if __name__ == "__main__":
    main()
