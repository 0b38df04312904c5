"""Settings of the learning step."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Literal

from pydantic import Field, field_validator, model_validator

from lanenet.config import Settings

#: How often each label set is shown in an epoch: as often as it has frames, or as often as every other one.
Balance = Literal["none", "drive"]


class AugmentSettings(Settings):
    """How a sample is changed before it becomes a raster; all of it in cm, on the edge points.

    What the car was told (speed, steering) is not changed: labels and rasters do not depend on it.

    Attributes:
        mirror: Probability that left and right are swapped.
        shift_cm: The car is moved sideways by up to this much, evenly in both directions.
        rotate_rad: The car is turned about its front axle by up to this much.
        scale: All lengths, those of the labels too, become larger or smaller by up to this share: another
            lane width, another tape, another height of the camera.
        drop_points: Up to this share of the edge points is dropped, a new share for every sample.
        double_points: Up to this share of the edge points comes twice, the second within 1.5 cm.
        jitter_cm: Standard deviation of the noise on each edge point.
        missing_stretch: Probability that the points in a disc or ring are dropped (glare, worn paint).
        missing_line: Probability that the points of one of the two lines are dropped.
        missing_both: Probability that the points of both are.
        objects: Up to this many closed outlines of unknown things; boxes, cones and cars hide the road below
            them, shadows do not.
        clutter_segments: Up to this many straight edges of things that are not lanes.
        clutter_points: Up to this many single points.
        clutter_share: Points and straight edges are added until they mark up to this share of what the frame
            itself marks.
        height: The camera's height is taken wrong by up to this share; the points move as they would, the
            labels do not.
        pitch_rad: Its pitch is taken wrong by up to this much.
        roll_rad: Its roll likewise.
        draw: ``even`` draws every amount anew for each sample; ``limit`` takes all amounts at their limits,
            with either sign, for tests of robustness.
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
    objects: int = Field(default=2, ge=0, le=20)
    clutter_segments: int = Field(default=4, ge=0, le=100)
    clutter_points: int = Field(default=30, ge=0, le=2000)
    clutter_share: float = Field(default=0.3, ge=0.0, le=3.0)
    height: float = Field(default=0.03, ge=0.0, le=0.3)
    pitch_rad: float = Field(default=0.0175, ge=0.0, le=0.2)
    roll_rad: float = Field(default=0.0175, ge=0.0, le=0.2)
    draw: Literal["even", "limit"] = "even"

    @model_validator(mode="after")
    def _lines_missing_at_most_always(self) -> AugmentSettings:
        if self.missing_line + self.missing_both > 1.0:
            raise ValueError("missing_line and missing_both must sum to at most 1")
        return self


class NetworkSettings(Settings):
    """Size of the network.

    Attributes:
        channels: Output channels of the convolutions; each halves rows and columns.
        hidden: Width of the fully connected layer before the six outputs.
    """

    channels: tuple[int, ...] = (8, 16, 32, 48, 64)
    hidden: int = Field(default=64, ge=4, le=1024)

    @field_validator("channels")
    @classmethod
    def _check_channels(cls, value: tuple[int, ...]) -> tuple[int, ...]:
        if not 1 <= len(value) <= 6 or any(not 1 <= c <= 512 for c in value):
            raise ValueError("expected one to six layers of 1 to 512 channels")
        return value


class LearnSettings(Settings):
    """How a network is trained.

    Attributes:
        seed: Of the first weights, of the order of the samples and of the augmentation.
        epochs: Passes over the training samples.
        batch_size: Samples per step.
        learning_rate: Peak of the learning rate (AdamW).
        weight_decay: Of AdamW, on the weights but not on biases and norms.
        warmup: Share of all steps over which the learning rate rises from zero; a cosine leads it down.
        ema_decay: Of the running mean of the weights, which is what is evaluated and exported.
        huber_cm: Errors below this count squared, above it linearly.
        min_quality: Training frames whose labels have a lower quality are left out.
        threads: Threads of the computation; 0 leaves the choice to torch. One thread gives the same weights
            on any number of cores, and does not stall when other programs are busy; a second core prepares
            the next batches meanwhile.
        balance: ``drive`` shows every training drive equally often, however many frames it has.
        start_from: Checkpoint folder whose weights the training starts from, for fine-tuning; None starts
            anew.
        checkpoint_every: Epochs between two writings of the state from which a stopped run goes on.
        augment: Changes of the samples.
        network: Size of the network.
    """

    seed: int = Field(default=0, ge=0)
    epochs: int = Field(default=12, ge=1)
    batch_size: int = Field(default=64, ge=2)
    learning_rate: float = Field(default=3e-3, gt=0.0)
    weight_decay: float = Field(default=1e-2, ge=0.0)
    warmup: float = Field(default=0.05, ge=0.0, lt=1.0)
    ema_decay: float = Field(default=0.995, ge=0.0, lt=1.0)
    huber_cm: float = Field(default=2.0, gt=0.0)
    min_quality: float = Field(default=0.0, ge=0.0, le=1.0)
    threads: int = Field(default=1, ge=0)
    balance: Balance = "none"
    start_from: Path | None = None
    checkpoint_every: int = Field(default=1, ge=1)
    augment: AugmentSettings = AugmentSettings()
    network: NetworkSettings = NetworkSettings()

    @property
    def hash(self) -> str:
        """Short hash of every setting that decides the result (not: threads, checkpoint_every)."""
        data = self.model_dump(mode="json", exclude={"threads", "checkpoint_every"})
        return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()[:16]
