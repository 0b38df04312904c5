"""Refusals: of labels of a rejected map, which is kept to be looked at, and beside an older map."""

from __future__ import annotations

import json
from pathlib import Path

from datagen.map_folder import DriveMap
from datagen.report.page import PAGE_NAME
from lanenet.config import read_yaml
from lanenet.errors import ConfigError, TrackingLostError


def kept_map(out: Path) -> str:
    """Say, after a refusal, that the map which lies where the new one was to be written is an older one.

    Args:
        out: Where the new one was to be written.

    Returns:
        The end of a sentence; empty where no map lies there.
    """
    if not (out / "map.yaml").is_file():
        return ""
    try:
        verdict = read_yaml(out / "map.yaml").get("verdict")
    except ConfigError:  # it was kept, whatever it is
        verdict = None
    return f"; the map at {out} is an older one, which was kept (verdict: {verdict or 'none'})"


def refuse_rejected(map_folder: Path, drive_map: DriveMap) -> None:
    """Raise if the map was rejected.

    Args:
        map_folder: Where it lies, with its report.
        drive_map: The map.

    Raises:
        TrackingLostError: With the first reason, and where the others stand.
    """
    if drive_map.meta.verdict != "reject":
        return
    try:
        reasons = json.loads((map_folder / "report.json").read_text(encoding="utf-8"))["verdict"]["reasons"]
        reason = str(reasons[0])
    except (OSError, ValueError, LookupError, TypeError):  # the verdict stands without its reasons
        reason = "its report cannot be read"
    page = map_folder / PAGE_NAME
    # Maps of which nobody wants pictures have no page.
    told_by = page if page.is_file() else map_folder / "report.json"
    raise TrackingLostError(
        f"{map_folder}: the map was rejected: {reason}; see {told_by}, and label it with --force if it is to "
        "be used all the same"
    )
