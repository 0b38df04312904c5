"""A data sheet for people, as Markdown, and the two files of it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from datagen.datasets.settings import ROLES
from datagen.datasets.sheet import Sheet
from lanenet.data.files import json_text
from lanenet.errors import counted

JSON_NAME, TEXT_NAME = "data_sheet.json", "DATA_SHEET.md"
UNKNOWN = "not recorded"


def sheet_files(sheet: Sheet) -> dict[str, str]:
    """Return the sheet as files by name: one for programs, one for people."""
    return {JSON_NAME: json_text(sheet), TEXT_NAME: as_text(sheet)}


def as_text(sheet: Sheet) -> str:
    """Write a data sheet as Markdown."""
    made_by, simulated = sheet["made_by"], sheet["simulated"]
    parts = [
        f"# The data of {sheet['name']}",
        f"Made by lanenet {_known(made_by['lanenet'])}, commit {_known(made_by['commit'])}. "
        f"For programs: `{JSON_NAME}`.",
        _extents(sheet["parts"]),
    ]
    if simulated is not None:
        parts.append(_simulated(simulated))
    if sheet.get("licences"):
        parts.append(_licences(sheet["licences"]))
    parts += [_recorded(drive) for drive in sheet["recorded"]]
    if not sheet["recorded"]:
        parts.append("## Recorded drives\n\nNone: it has seen no real image.")
    return "\n\n".join([*parts, *sheet.get("notes", [])]) + "\n"


def _extents(parts: Mapping[str, Mapping[str, int | float | None]]) -> str:
    """Table of the roles, with what the label sets hold."""
    rows = [
        f"| {role} | {_number(part['drives'], 0)} | {_number(part['frames'], 0)} | "
        f"{_number(part['minutes'], 1)} | {_number(part['km'], 2)} |"
        for role, part in parts.items()
    ]
    head = [
        "| part | label sets | frames with labels | minutes | km |",
        "| --- | ---: | ---: | ---: | ---: |",
    ]
    return "\n".join([*head, *rows])


def _licences(licences: Mapping[str, Mapping[str, int | float]]) -> str:
    """Table of the recorded drives by their licences."""
    rows = [
        f"| {licence or UNKNOWN} | {total['drives']} | {total['frames']} | {total['minutes']:.1f} | "
        f"{total['km']:.2f} |"
        for licence, total in licences.items()
    ]
    head = [
        "| licence | recorded drives | frames with labels | minutes | km |",
        "| --- | ---: | ---: | ---: | ---: |",
    ]
    return "\n".join(["## Recorded drives by licence", "", *head, *rows])


def _simulated(facts: Mapping[str, Any]) -> str:
    described, made = facts["described"], facts["made"]
    asked = ", ".join(
        f"{role} {_number(made[role], 0)} of {facts['asked'][role]}" for role in ROLES if facts["asked"][role]
    )
    seconds = facts["frames_each"] / facts["rate_hz"]
    lines = [
        f"Seed {facts['seed']}, variety `{facts['variety']}`. Drives with labels, of those asked for: "
        f"{asked}. Each has {counted(facts['frames_each'], 'frame')} at {facts['rate_hz']:g} Hz, "
        f"{seconds:g} s.",
        f"The rest of this section describes the {described['drives']} training drives that were "
        f"{described['which']}, by what was drawn for them.",
    ]
    lines.insert(1, _left_out(facts["left_out"]))
    items = [
        f"roads: {_shares(facts['roads'])}",
        f"of these {_shares(facts['shapes'])}; {_shares(facts['lanes'])}",
        f"of straights and kinks: {facts['with_kinks']}; with tight corners: {facts['with_corners']}; "
        f"wider in bends: {facts['with_widening']}",
        f"lane width: {_range(facts['lane_width_cm'], 'cm')}; width of the tape: "
        f"{_range(facts['marking_cm'], 'cm')}",
        *(
            f"{name} line ({sum(kinds.values())} roads): {_shares(kinds)}"
            for name, kinds in facts["lines"].items()
        ),
        f"commanded speed: {_range(facts['speed_cm_s'], 'cm/s')}; wheelbase: "
        f"{_range(facts['wheelbase_cm'], 'cm')}",
        *(f"camera: {_camera(camera)}" for camera in facts["cameras"]),
    ]
    return "\n\n".join(["## Simulated drives", *lines, "\n".join(f"- {item}" for item in items)])


def _left_out(reasons: Mapping[str, int] | None) -> str:
    if reasons is None:
        return f"Why the others have no labels: {UNKNOWN}."
    if not reasons:
        return "None was left out."
    return "Left out, with numbers as #:\n\n" + "\n".join(f"- {n}: {why}" for why, n in reasons.items())


def _recorded(facts: Mapping[str, Any]) -> str:
    camera, lines = facts["camera"], facts["lines"]
    kinds = (
        UNKNOWN if lines is None else ", ".join(f"{side} {kind}" for side, kind in lines.items()) or UNKNOWN
    )
    laps = "" if facts["laps"] is None else f", {counted(facts['laps'], 'lap')}"
    items = [
        f"licence: {_known(facts['licence'])}; car: {_known(facts['car'])}; track: {_known(facts['track'])}",
        f"labels from its {facts['from']}, verdict {_known(facts['verdict'])}; split: {facts['split']}; "
        f"counts as {counted(facts['counts_as'], 'drive')}, weight {facts.get('weight', 1.0):g}",
        f"road: {_known(facts['shape'])}{laps}; lines: {kinds}",
        f"lane width: {facts['lane_width_cm']:g} cm, as given; width of the tape: "
        f"{_number(facts['marking_cm'], 1)} cm",
        f"camera: {UNKNOWN if camera is None else _camera(camera)}",
    ]
    return "\n\n".join(
        [
            f"## Recorded drive {facts['name']}",
            _extents(facts["parts"]),
            "\n".join(f"- {item}" for item in items),
        ]
    )


def _camera(facts: Mapping[str, Any]) -> str:
    return (
        f"{facts['model']}, {facts['width_px']} x {facts['height_px']} px, "
        f"focal length {_range(facts['focal_px'], 'px')}, field of view "
        f"{_range(facts['field_of_view_deg'], 'degrees')}, height {_range(facts['camera_height_cm'], 'cm')}, "
        f"pitch {_range(facts['pitch_down_deg'], 'degrees')} down ({counted(facts['drives'], 'drive')})"
    )


def _shares(counts: Mapping[str, int]) -> str:
    return "; ".join(f"{name}: {count}" for name, count in counts.items())


def _range(values: Mapping[str, float] | None, unit: str) -> str:
    if values is None:
        return UNKNOWN
    if values["min"] == values["max"]:
        return f"{values['min']:.4g} {unit}"
    return f"{values['min']:.3g} to {values['max']:.3g} {unit} (median {values['median']:.3g})"


def _number(value: int | float | None, digits: int) -> str:
    return UNKNOWN if value is None else f"{value:.{digits}f}"


def _known(value: str | None) -> str:
    return UNKNOWN if value is None else value
