"""How samples are drawn from label sets: the balance between sets, and the augmentation."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, model_validator

from lanenet.config import Settings

#: How often each label set is shown in an epoch: in proportion to its frames, or as often as every other one.
Balance = Literal["none", "drive"]

#: Named amounts of augmentation. Chosen on the validation lap of garage_tape: docs/learning.md, "Results".
_PRESETS: dict[str, dict[str, object]] = {
    # For one car on its road, in one direction: the camera was found from the drive itself, and the frames
    # show the clutter that there is.
    "own_road": {
        "mirror": 0.0,
        "drop_points": 0.2,
        "missing_stretch": 0.1,
        "missing_line": 0.05,
        "missing_both": 0.0,
        "inverted": 0.0,
        "colourless": 0.05,
        "objects": 0,
        "clutter_segments": 1,
        "clutter_points": 10,
        "clutter_share": 0.1,
        "height": 0.01,
        "pitch_rad": 0.005,
        "roll_rad": 0.005,
    },
}


class AugmentSettings(Settings):
    """How a sample is changed before it becomes a raster; all of it in cm, on the edge points.

    The defaults are for a network that meets other cars and roads; they were chosen, and what some of them
    bring was measured in docs/learning.md ("Choices"). ``preset: own_road`` stands for less, for one car on
    its own road, ``preset: none`` for frames as they are; keys beside it change that. Once read, only the
    values are left.

    Attributes:
        mirror: Probability that left and right are swapped.
        shift_cm: The car is moved sideways by up to this much, in either direction.
        rotate_rad: The car is turned about its front axle by up to this much.
        scale: All lengths, those of the labels too, grow or shrink by up to this share: another lane width,
            another tape, another height of the camera.
        drop_points: Up to this share of the edge points is dropped; the share is drawn for every sample.
        double_points: Up to this share of the edge points is doubled, the second within 1.5 cm.
        jitter_cm: Sigma of the noise on each edge point.
        missing_stretch: Probability that the points in a disc or ring are dropped (glare, worn paint).
        missing_line: Probability that the points of one of the two lines are dropped, and with them edges
            that run along it farther out: the next lane's border would be taken for the missing line.
        missing_both: Probability that the points of both are.
        middle_dashes: Probability that a dashed line runs along the middle of the lane, where the network is
            given the lane width.
        objects: Up to this many closed outlines of unknown things; boxes, cones and cars hide the road below
            them, shadows do not.
        clutter_segments: Up to this many straight edges of things that are not lanes.
        clutter_points: Up to this many single points.
        clutter_share: Points and straight edges are added until they mark up to this share of the cells that
            the frame itself marks.
        height: The camera's assumed height is wrong by up to this share; the points move, the labels do not.
        pitch_rad: Its assumed pitch is wrong by up to this much.
        roll_rad: Its assumed roll likewise.
        untold_width: Probability that the lane width is kept from a network that takes it.
        inverted: Probability that bright and dark change places: markings of dark tape on a bright floor.
        colourless: Probability that colours are lost, as in gray light.
        hue_gain: All hues of a frame grow or shrink by up to this share: cameras store colour weaker or
            stronger.
        hue_cast: By up to this the light adds to each hue of a frame; 1 is all of an edge.
        width_error: The given lane width is wrong by up to this share.
        draw: ``even`` draws every amount for each sample; ``limit`` takes all amounts at their limits, with
            either sign, for tests of robustness.
    """

    mirror: float = Field(default=0.5, ge=0.0, le=1.0)
    shift_cm: float = Field(default=8.0, ge=0.0, le=50.0)
    rotate_rad: float = Field(default=0.26, ge=0.0, le=0.8)
    scale: float = Field(default=0.0, ge=0.0, le=1.0)
    drop_points: float = Field(default=0.3, ge=0.0, lt=1.0)
    double_points: float = Field(default=0.1, ge=0.0, le=1.0)
    jitter_cm: float = Field(default=0.15, ge=0.0, le=5.0)
    missing_stretch: float = Field(default=0.3, ge=0.0, le=1.0)
    missing_line: float = Field(default=0.25, ge=0.0, le=1.0)
    missing_both: float = Field(default=0.05, ge=0.0, le=1.0)
    middle_dashes: float = Field(default=0.0, ge=0.0, le=1.0)
    objects: int = Field(default=2, ge=0, le=20)
    clutter_segments: int = Field(default=4, ge=0, le=100)
    clutter_points: int = Field(default=30, ge=0, le=2000)
    clutter_share: float = Field(default=0.3, ge=0.0, le=3.0)
    height: float = Field(default=0.03, ge=0.0, le=0.3)
    pitch_rad: float = Field(default=0.0175, ge=0.0, le=0.2)
    roll_rad: float = Field(default=0.0175, ge=0.0, le=0.2)
    untold_width: float = Field(default=0.3, ge=0.0, le=1.0)
    width_error: float = Field(default=0.02, ge=0.0, le=0.3)
    inverted: float = Field(default=0.1, ge=0.0, le=1.0)
    colourless: float = Field(default=0.2, ge=0.0, le=1.0)
    hue_gain: float = Field(default=0.5, ge=0.0, le=2.0)
    hue_cast: float = Field(default=0.15, ge=0.0, le=1.0)
    draw: Literal["even", "limit"] = "even"

    @model_validator(mode="before")
    @classmethod
    def _on_top_of_its_preset(cls, data: Any) -> Any:
        if not isinstance(data, dict) or "preset" not in data:
            return data
        changes = dict(data)
        name = changes.pop("preset")
        nothing: dict[str, object] = {field: 0 for field in cls.model_fields if field != "draw"}
        presets = {**_PRESETS, "none": nothing}
        if not isinstance(name, str) or name not in presets:
            raise ValueError(f"no preset {name!r}, expected one of {', '.join(presets)}")
        return {**presets[name], **changes}

    @model_validator(mode="after")
    def _lines_missing_at_most_always(self) -> AugmentSettings:
        if self.missing_line + self.missing_both > 1.0:
            raise ValueError("missing_line and missing_both must sum to at most 1")
        return self

    @classmethod
    def only(cls, **changes: object) -> AugmentSettings:
        """Return settings that change nothing but what is named."""
        return cls.model_validate({"preset": "none"} | changes)
