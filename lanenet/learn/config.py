"""Settings of the learning step."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from lanenet.config import Settings
from lanenet.learn.trunks import TRUNKS
from lanenet.samples.settings import AugmentSettings, Balance

#: What settings of a network are where its trunk does not use them.
_UNUSED: dict[str, Any] = {
    "channels": None,
    "hidden": None,
    "bins": 0,
    "planes": 1,
    "takes_width": False,
    "weights": None,
}


#: Settings of the training that do not decide its result, or only together with the data.
_UNDECIDING = {"device", "threads", "processes", "memory_mb", "checkpoint_every", "tensorboard"}


class NetworkSettings(Settings):
    """Which network, and its size.

    Attributes:
        kind: A name in :data:`lanenet.learn.trunks.TRUNKS`: ``nano``, ``small`` and ``base`` are one trunk in
            three sizes; ``alexnet`` is the paper's.
        channels: Output channels of the convolutions: the first divides rows and columns by four, each other
            one by two. None takes those of the kind.
        hidden: Width of the fully connected layer before the outputs; None takes that of the kind.
        bins: The network answers each point as a distribution over this many places from the left to the
            right end of the window; 0 as a number with its sigma. The default was compared with numbers in
            docs/learning.md ("Choices"): RMSE 0.45 cm against 0.51 cm. Without bins for ``alexnet``.
        planes: How many planes of a raster it sees, see :data:`lanenet.perception.edges.raster.PLANES`: 1 for
            edges alone, 5 for their directions and colours too.
        takes_width: The network can be given the lane width beside the raster. Where lanes of many widths are
            learned together, the width tells the lane from two lanes, or from half a lane.
        weights: File with pretrained weights, for ``alexnet`` as torchvision names them; None starts from
            random weights.
    """

    kind: str = "small"
    channels: tuple[Annotated[int, Field(ge=1, le=512)], ...] | None = Field(
        default=None, min_length=1, max_length=6
    )
    hidden: int | None = Field(default=None, ge=4, le=1024)
    bins: int = Field(default=64, ge=0, le=512)
    planes: Literal[1, 5] = 5
    takes_width: bool = False
    weights: Path | None = None

    @model_validator(mode="before")
    @classmethod
    def _no_bins_where_they_cannot_be(cls, data: Any) -> Any:
        trunk = TRUNKS.get(data.get("kind", "small")) if isinstance(data, dict) else None
        if trunk is None or "bins" in trunk.uses:
            return data
        return {**{name: _UNUSED[name] for name in ("bins", "planes")}, **data}

    @field_validator("bins")
    @classmethod
    def _check_bins(cls, value: int) -> int:
        if value == 1:
            raise ValueError("expected 0, or at least 2: one bin would answer the same x for all points")
        return value

    @field_validator("kind")
    @classmethod
    def _check_kind(cls, value: str) -> str:
        if value not in TRUNKS:
            raise ValueError(f"no network {value!r}, expected one of {', '.join(TRUNKS)}")
        return value

    @model_validator(mode="after")
    def _check_uses(self) -> NetworkSettings:
        for name, unused in _UNUSED.items():
            if getattr(self, name) != unused and name not in TRUNKS[self.kind].uses:
                raise ValueError(f"{name}: {self.kind} does not use it, found {getattr(self, name)}")
        return self


class LossSettings(Settings):
    """What the training minimises; see :func:`lanenet.learn.loss.lane_loss`.

    The comparisons behind the defaults are in docs/learning.md, "Choices".

    Attributes:
        distance: For a network with bins, weight of the distance of the points, and of the likelihood of
            their errors (which trains sigma alone), beside the cross-entropy of the bins. Chosen.
        kind: Distribution of the errors: ``student`` (heavy tails, round centre), ``laplace`` (heavy tails,
            sharp centre) or ``gaussian`` (no outliers). RMSE 0.70 cm with the first, 0.75 with the second.
        evenness: Each point's term is multiplied by this power of the predicted sigma: 0 is the plain
            likelihood, which gives uncertain points little weight; 1 weighs all points alike. Median 0.83 cm
            with 0.5, 1.03 cm with 1.
        presence: Weight of the presence of the lines beside the points. With 0.2 and few missing lines, 30 %
            of them were noticed; with 1.0 and more of them 90 %.
    """

    distance: float = Field(default=0.3, ge=0.0)
    kind: Literal["student", "laplace", "gaussian"] = "student"
    evenness: float = Field(default=0.5, ge=0.0, le=2.0)
    presence: float = Field(default=1.0, ge=0.0)


class LearnSettings(Settings):
    """How a network is trained.

    Attributes:
        seed: Of the first weights, the order of the samples and the augmentation.
        epochs: Passes over the training samples, at most. 12 suits a trial; the shipped configs name theirs.
        patience: The training ends after this many epochs in a row without a better validation error; 0 never
            ends it early.
        batch_size: Samples per step. Chosen; on one's own road 32 was better than 64.
        learning_rate: Peak of the learning rate (AdamW). Chosen; 0.0055 gave the same RMSE.
        head_rate: Factor on the learning rate of a new head on a pretrained trunk (the paper's 10).
        weight_decay: Of AdamW, on the weights but not on biases and norms. PyTorch's default.
        warmup: Share of all steps over which the learning rate rises from zero; a cosine lowers it
            afterwards. Chosen.
        ema_decay: Of the running mean of the weights, which is what is evaluated and exported. Chosen: it
            averages over the last 200 steps.
        loss: What is minimised.
        min_quality: Training frames whose labels have a lower quality are left out.
        device: Where the network is computed: ``auto`` uses a GPU if there is one.
        threads: Threads of the computation; 0 leaves the choice to torch. One thread gives the same weights
            on any number of cores, and does not stall when other programs are busy; a second core prepares
            the next batches meanwhile.
        processes: How many share the training, each with its part of every batch and its own memory. The
            weights are those of one process up to the order of sums. Under ``torchrun`` they are those that
            it starts.
        balance: ``drive`` shows every training drive equally often, however many frames it has.
        start_from: Checkpoint folder whose weights the training starts from, for fine-tuning.
        memory_mb: What samples may take in the memory of each process, [MiB]. Label sets that unpack to more
            are streamed: their row groups are read again in each epoch, and frames are shuffled only over as
            many as fit. Chosen: more than the shipped configs need, and less than a desktop computer has.
        checkpoint_every: Epochs between two writings of the state from which a stopped run resumes.
        tensorboard: Also write the curve for TensorBoard, into ``tensorboard/`` beside the state.
        augment: Augmentation of the samples.
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
    processes: int = Field(default=1, ge=1)
    balance: Balance = "none"
    start_from: Path | None = None
    memory_mb: int = Field(default=8000, ge=1)
    checkpoint_every: int = Field(default=1, ge=1)
    tensorboard: bool = False
    augment: AugmentSettings = AugmentSettings()
    network: NetworkSettings = NetworkSettings()

    @property
    def hash(self) -> str:
        """Short hash of every setting that decides the result; threads and the like do not.

        Nor does ``memory_mb`` where all samples fit; where they do not, the hash of the run holds it.
        """
        data = self.model_dump(mode="json", exclude=_UNDECIDING)
        return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()[:16]
