"""Roads as data: what a YAML file, a preset or the settings of a drive say about a road."""

from __future__ import annotations

import math
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, PrivateAttr, model_validator

from datagen.world.road.furniture import Furniture, FurnitureRates
from datagen.world.road.pieces import Piece, length_of
from lanenet.config import Settings, check_settings, read_yaml
from lanenet.errors import ConfigError, did_you_mean

#: Length of a road that is given none; chosen: twenty seconds at 60 cm/s.
LOOP_CM = 1200.0


class MarkingSettings(Settings):
    """How one line of the road is painted.

    Attributes:
        kind: ``random`` is dashed on every other road, on average; ``none`` is a line without paint.
        colour: ``random`` is yellow on every other road, on average.
        dash_cm: Painted length of a dashed line, along the line itself.
        gap_cm: Length between dashes.
        phase: Where the pattern starts, in periods; None: at random.
        width_cm: Of the tape; None: the road's ``line_width_cm``.
        double_gap_cm: Between the two tapes of a double line.
        wear: Share of the paint that has flaked off, in short sections.
        interruptions: Sections without paint, from and to along the centre line, [cm].
        interruptions_per_m: Random ones in addition; None: the road's ``interruptions_per_m``.
    """

    kind: Literal["solid", "dashed", "double", "none", "random"] = "solid"
    colour: Literal["white", "yellow", "orange", "red", "blue", "black", "random"] = "white"
    dash_cm: float = Field(default=20.0, gt=0.0)
    gap_cm: float = Field(default=20.0, gt=0.0)
    phase: float | None = Field(default=None, ge=0.0, le=1.0)
    width_cm: float | None = Field(default=None, gt=0.0)
    double_gap_cm: float = Field(default=2.0, gt=0.0)
    wear: float = Field(default=0.0, ge=0.0, lt=1.0)
    interruptions: tuple[tuple[float, float], ...] = ()
    interruptions_per_m: float | None = Field(default=None, ge=0.0)

    @model_validator(mode="after")
    def _interruptions_run_forwards(self) -> MarkingSettings:
        for start, end in self.interruptions:
            if not 0.0 <= start < end:
                raise ValueError(
                    f"expected interruptions as [from, to] with 0 <= from < to, found [{start}, {end}]"
                )
        return self


class ExtraLineSettings(MarkingSettings):
    """A further line along the road, as on a mat with more lanes than the one that is driven.

    Attributes:
        at_lanes: From the middle of the driven lane, left positive, in lane widths.
    """

    at_lanes: float


class TrackSettings(Settings):
    """A road: from pieces, or drawn at random.

    With two lanes the car keeps to the right one: ``right`` and ``middle`` bound it, ``far`` is the other
    side of the road. With one lane these are ``left`` and ``right``.

    Attributes:
        preset: Name of a road that comes with this package; the other keys change it.
        file: YAML file with these same keys; the other keys change it. The contents take its place here.
        lane_width_cm: Between the middles of the two lines of a lane.
        line_width_cm: Width of the tape.
        min_radius_cm: Of the centre line of either lane, where the road is drawn at random.
        corners: Share of the pieces of a random open road, from 0 to 1, that are corners: turns of 80 to 100
            degrees at up to 1.25 times ``min_radius_cm``, as tape laid round a garage has them, each with a
            straight behind it.
        closed: A loop instead of a road with two ends.
        crosses: The road may cross itself, as a figure of eight does; it has no lines on the crossing.
        widening: Share by which the lane is wider in the tightest bend of this road, in easier bends less.
        length_cm: Along the centre line; None: as long as the drive needs, or 1200 cm for a loop. Given by
            the pieces where there are any.
        lanes: One, or two with traffic in both directions.
        left: Left line of a road with one lane.
        right: Line on the right.
        middle: Line between two lanes.
        far: Left line of a road with two lanes.
        extra_lines: Further lines along a road from pieces; things beside the road do not keep clear of them.
        interruptions_per_m: Sections where paint is missing, for each line.
        max_interruption_cm: Longest such section.
        pieces: The road in the direction of travel; none: a random road.
        furniture: Things on the road.
        random_furniture: Random ones in addition.
        floor_bgr: Colour of the floor that belongs to this road; None: any.
    """

    preset: str | None = None
    file: Path | None = None
    lane_width_cm: float = Field(default=40.0, gt=0.0)
    line_width_cm: float = Field(default=2.0, gt=0.0)
    min_radius_cm: float = Field(default=60.0, gt=0.0)
    corners: float = Field(default=0.0, ge=0.0, le=1.0)
    closed: bool = False
    crosses: bool = False
    widening: float = Field(default=0.0, ge=0.0, lt=1.0)
    length_cm: float | None = Field(default=None, gt=100.0)
    lanes: Literal[1, 2] = 1
    left: MarkingSettings | None = MarkingSettings(kind="random", colour="random")
    right: MarkingSettings = MarkingSettings()
    middle: MarkingSettings | None = None
    far: MarkingSettings | None = None
    extra_lines: tuple[ExtraLineSettings, ...] = ()
    interruptions_per_m: float = Field(default=0.1, ge=0.0)
    max_interruption_cm: float = Field(default=100.0, ge=10.0, le=100.0)
    pieces: tuple[Piece, ...] = ()
    furniture: tuple[Furniture, ...] = ()
    random_furniture: FurnitureRates = FurnitureRates()
    floor_bgr: tuple[float, float, float] | None = None

    _origin: str = PrivateAttr(default="track")

    @model_validator(mode="wrap")
    @classmethod
    def _on_top_of_its_base(cls, data: Any, handler: Callable[[Any], Any]) -> Any:
        if not isinstance(data, dict):
            return handler(data)
        try:
            data, origin = _with_base(data)
        except ConfigError as error:
            # As one of the schema's own errors, so that the key that leads here is named too.
            raise ValueError(str(error)) from None
        if data.get("lanes") == 2:
            data = {"left": None, "middle": {"kind": "dashed"}, "far": {}, **data}
        settings = handler(data)
        settings._origin = origin
        wanted = ("left", "right") if settings.lanes == 1 else ("middle", "right", "far")
        for name in ("left", "middle", "far"):
            found = getattr(settings, name) is not None
            if found != (name in wanted):
                raise ValueError(
                    f"key {name!r}: a road of {settings.lanes} lane(s) has the lines {', '.join(wanted)}; "
                    f"the others are null, found {'a line' if found else 'none'} for {name}"
                )
        if settings.widening > 0.0 and settings.lanes == 2:
            raise ValueError(
                f"key 'widening': found {settings.widening:g} for a road of two lanes, expected 0: only "
                "roads of one lane widen"
            )
        if settings.extra_lines and not settings.pieces:
            raise ValueError(
                f"key 'extra_lines': found {len(settings.extra_lines)} on a road drawn at random, expected "
                "none, or a road from pieces"
            )
        if settings.crosses and not settings.pieces:
            raise ValueError("key 'crosses': found true for a road drawn at random, expected one from pieces")
        if settings.corners > 0.0 and (settings.closed or settings.pieces):
            kind = "from pieces" if settings.pieces else "that is a loop"
            raise ValueError(
                f"key 'corners': found {settings.corners:g} for a road {kind}, expected 0: only open roads "
                "drawn at random have them (closed: false)"
            )
        return settings

    @property
    def origin(self) -> str:
        """What errors call this road: the file that it comes from."""
        return self._origin

    @property
    def lines(self) -> dict[str, tuple[float, MarkingSettings]]:
        """The lines with their offsets from the centre line of the driven lane, left positive, [cm]."""
        half_cm = 0.5 * self.lane_width_cm
        lines: dict[str, tuple[float, MarkingSettings | None]] = {
            "left": (half_cm, self.left),
            "middle": (half_cm, self.middle),
            "right": (-half_cm, self.right),
            "far": (3.0 * half_cm, self.far),
        }
        for number, line in enumerate(self.extra_lines):
            lines[f"extra_lines.{number}"] = line.at_lanes * self.lane_width_cm, line
        return {name: (at_cm, line) for name, (at_cm, line) in lines.items() if line is not None}

    @property
    def tightest_radius_cm(self) -> float:
        """Smallest radius of the driven lane's centre line, [cm]; infinite where it has straights only."""
        if not self.pieces:
            return self.min_radius_cm
        return min(
            (radius_cm for piece in self.pieces for _, radius_cm, _ in piece.bends()), default=math.inf
        )


def preset_names() -> list[str]:
    """Names of the roads that come with this package."""
    return sorted(
        entry.name.removesuffix(".yaml") for entry in _presets().iterdir() if entry.name.endswith(".yaml")
    )


def preset(name: str) -> TrackSettings:
    """Return a road that comes with this package.

    Raises:
        ConfigError: If there is none of that name.
    """
    return check_settings(TrackSettings, {"preset": name}, "track")


def load_track_settings(path: Path, above: tuple[Path, ...] = ()) -> TrackSettings:
    """Read a road from a YAML file.

    Args:
        path: The file.
        above: Files of which this one is the base.

    Raises:
        ConfigError: Naming the file, the key, what was found and what was expected.
    """
    if path.resolve() in above:
        raise ConfigError(f"{path}: key 'file': found a file that is its own base, expected another one")
    data, _ = _with_base(read_yaml(path), str(path), (*above, path.resolve()))
    settings = check_settings(TrackSettings, data, str(path))
    settings._origin = str(path)
    return settings


def _with_base(
    data: dict[str, Any], origin: str = "track", above: tuple[Path, ...] = ()
) -> tuple[dict[str, Any], str]:
    """Put the given keys over those of a file or preset; return them and their origin."""
    name, file = data.get("preset"), data.get("file")
    if name is not None and file is not None:
        raise ConfigError(f"found preset {name!r} and file '{file}', expected one of them")
    if file is not None:
        path = Path(file)
        if above and (above[-1].parent / path).exists():  # beside the file that names it
            path = above[-1].parent / path
        base, origin = load_track_settings(path, above).model_dump(exclude_unset=True), str(path)
        base.pop("preset", None)
        data = _merge(base, {key: value for key, value in data.items() if key != "file"})
        return _with_length(data, origin), origin
    if isinstance(name, str):
        if name not in preset_names():
            hint = did_you_mean(name, preset_names()) or f", expected one of {', '.join(preset_names())}"
            raise ConfigError(f"no preset {name!r}{hint}")
        with resources.as_file(_presets() / f"{name}.yaml") as path:
            return _merge(read_yaml(path), data), f"preset {name}"
    return _with_length(data, origin), origin


def _with_length(data: dict[str, Any], origin: str) -> dict[str, Any]:
    """Write in the length that the pieces have."""
    if not data.get("pieces"):
        return data
    try:
        pieces = [Piece.model_validate(piece) for piece in data["pieces"]]
    except (TypeError, ValueError):
        return data  # the schema will report what is wrong with them
    length_cm = length_of(pieces)
    given = data.get("length_cm")
    if isinstance(given, (int, float)) and abs(given - length_cm) > 1e-6 * length_cm:
        raise ConfigError(
            f"{origin}: key 'length_cm': found {given:g}, but the pieces are {length_cm:.3f} cm long"
        )
    return {**data, "length_cm": length_cm}


def _merge(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """Put changes over a base, key by key."""
    merged = dict(base)
    for key, value in changes.items():
        below = merged.get(key)
        merged[key] = _merge(below, value) if isinstance(below, dict) and isinstance(value, dict) else value
    return merged


def _presets() -> Any:
    return resources.files("datagen.world") / "presets"
