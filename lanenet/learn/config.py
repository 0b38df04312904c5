"""Settings of the learning step."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, field_validator, model_validator

from lanenet.config import Settings
from lanenet.samples.settings import AugmentSettings, Balance

#: Channels of the convolutions and width of the fully connected layer of the compact family.
_SIZES: dict[str, tuple[tuple[int, ...], int]] = {
    "nano": ((8, 16, 24, 32, 40), 32),
    "small": ((16, 32, 48, 64, 80), 64),
    "base": ((24, 48, 72, 96, 120), 96),
}


class NetworkSettings(Settings):
    """Which network, and its size.

    Attributes:
        kind: ``nano``, ``small`` and ``base`` are one trunk in three sizes; ``alexnet`` is the paper's.
        channels: Output channels of the convolutions: the first divides rows and columns by four, each other
            one by two. None takes those of the kind.
        hidden: Width of the fully connected layer before the outputs; None takes that of the kind.
        bins: A point is answered as a distribution over so many places from the left to the right end of the
            window; 0: as a number and its spread, which is alexnet's way and that of older checkpoints.
        takes_width: The network can be told the lane's width beside the raster. Where lanes of many widths
            are learned together, that is what tells the lane from two lanes, or from half of one.
        weights: File with pretrained weights of AlexNet as torchvision names them; None starts from random
            ones.
    """

    kind: Literal["nano", "small", "base", "alexnet"] = "small"
    channels: tuple[int, ...] | None = None
    hidden: int | None = Field(default=None, ge=4, le=1024)
    bins: int = Field(default=64, ge=0, le=512)
    takes_width: bool = False
    weights: Path | None = None

    @model_validator(mode="before")
    @classmethod
    def _alexnet_answers_numbers(cls, data: Any) -> Any:
        if isinstance(data, dict) and data.get("kind") == "alexnet":
            return {"bins": 0, **data}
        return data

    @field_validator("channels")
    @classmethod
    def _check_channels(cls, value: tuple[int, ...] | None) -> tuple[int, ...] | None:
        if value is not None and (not 1 <= len(value) <= 6 or any(not 1 <= c <= 512 for c in value)):
            raise ValueError("expected one to six layers of 1 to 512 channels")
        return value

    @field_validator("bins")
    @classmethod
    def _check_bins(cls, value: int) -> int:
        if value == 1:
            raise ValueError("expected 0, or at least 2: one bin would answer the same x for all points")
        return value

    @model_validator(mode="after")
    def _check_kind(self) -> NetworkSettings:
        if self.kind == "alexnet" and (self.channels is not None or self.hidden is not None):
            raise ValueError("alexnet has a size of its own: expected neither channels nor hidden")
        if self.kind == "alexnet" and (self.takes_width or self.bins):
            raise ValueError(
                "alexnet takes a raster alone and answers numbers: expected takes_width: false and bins: 0"
            )
        if self.kind != "alexnet" and self.weights is not None:
            raise ValueError(f"weights are for alexnet; {self.kind} starts from random ones")
        return self

    @property
    def size(self) -> tuple[tuple[int, ...], int]:
        """Channels and hidden width of a compact network."""
        channels, hidden = _SIZES[self.kind]
        return self.channels or channels, self.hidden or hidden


class LossSettings(Settings):
    """What a network is trained to make small; see :func:`lanenet.learn.loss.lane_loss`.

    Attributes:
        distance: For a network with bins, weight of the distance of the points and of the likelihood of their
            errors (which then trains the spread alone) beside the probability of the bins.
        kind: How errors are thought to be spread about the answer: ``student`` (heavy tails, round middle),
            ``laplace`` (heavy tails, sharp middle) or ``gaussian`` (no outliers).
        evenness: Power of the predicted spread that each point's term is multiplied with: 0 is the plain
            likelihood, which cares little for points that it holds for uncertain; 1 lets them all pull alike.
        presence: Weight of the presence of the lines beside the points.
    """

    distance: float = Field(default=0.3, ge=0.0)
    kind: Literal["student", "laplace", "gaussian"] = "student"
    evenness: float = Field(default=0.5, ge=0.0, le=2.0)
    presence: float = Field(default=1.0, ge=0.0)


class LearnSettings(Settings):
    """How a network is trained.

    Attributes:
        seed: Of the first weights, of the order of the samples and of the augmentation.
        epochs: Passes over the training samples, at most.
        patience: The training ends once this many epochs in a row have brought no better validation error;
            0 never ends it early.
        batch_size: Samples per step.
        learning_rate: Peak of the learning rate (AdamW).
        head_rate: The learning rate of AlexNet's new layer is this many times higher.
        weight_decay: Of AdamW, on the weights but not on biases and norms.
        warmup: Share of all steps over which the learning rate rises from zero; a cosine leads it down.
        ema_decay: Of the running mean of the weights, which is what is evaluated and exported.
        loss: What is made small.
        min_quality: Training frames whose labels have a lower quality are left out.
        device: Where the network is computed: ``auto`` takes a GPU if there is one.
        threads: Threads of the computation; 0 leaves the choice to torch. One thread gives the same weights
            on any number of cores, and does not stall when other programs are busy; a second core prepares
            the next batches meanwhile.
        balance: ``drive`` shows every training drive equally often, however many frames it has.
        start_from: Checkpoint folder whose weights the training starts from, for fine-tuning; None starts
            anew.
        checkpoint_every: Epochs between two writings of the state from which a stopped run goes on.
        tensorboard: Write the curve for TensorBoard too, into ``tensorboard/`` beside the state.
        augment: Changes of the samples.
        network: Which network, and its size.
    """

    seed: int = Field(default=0, ge=0)
    epochs: int = Field(default=12, ge=1)
    patience: int = Field(default=0, ge=0)
    batch_size: int = Field(default=64, ge=2)
    learning_rate: float = Field(default=3e-3, gt=0.0)
    head_rate: float = Field(default=10.0, gt=0.0)
    weight_decay: float = Field(default=1e-2, ge=0.0)
    warmup: float = Field(default=0.05, ge=0.0, lt=1.0)
    ema_decay: float = Field(default=0.995, ge=0.0, lt=1.0)
    loss: LossSettings = LossSettings()
    min_quality: float = Field(default=0.0, ge=0.0, le=1.0)
    device: Literal["auto", "cpu", "cuda"] = "auto"
    threads: int = Field(default=1, ge=0)
    balance: Balance = "none"
    start_from: Path | None = None
    checkpoint_every: int = Field(default=1, ge=1)
    tensorboard: bool = False
    augment: AugmentSettings = AugmentSettings()
    network: NetworkSettings = NetworkSettings()

    @property
    def hash(self) -> str:
        """Short hash of every setting that decides the result (not: threads and other matters of the run)."""
        data = self.model_dump(mode="json", exclude={"device", "threads", "checkpoint_every", "tensorboard"})
        return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()[:16]
