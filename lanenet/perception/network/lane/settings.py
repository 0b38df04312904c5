"""The numbers of the lane filter, with their units; ``make fit-lane`` fits them.

Noises, forgetting and outliers are per frame, at 20 frames/s. The values were fitted to the likelihood of the
truth on 40 drives of seed 610000.
"""

from __future__ import annotations

from pydantic import Field

from lanenet.config import Settings


class MotionNoise(Settings):
    """What changes from frame to frame beside the motion that is known, as standard deviations.

    Attributes:
        offset_cm: Of the centre line's offset, in any frame.
        offset_share: The same per distance driven.
        slope: Of its slope, in any frame.
        slope_per_rad: The same per turn of the car.
        curvature_per_cm: Of its curvature, [1/cm]: bends begin at once.
        log_width: Of the logarithm of the width.
        usual_step_cm: Distance driven in a frame, where it is not known.
        usual_turn_rad: Turn likewise.
        unknown: Factor on ``offset_cm``, ``slope`` and ``curvature_per_cm`` where the motion is not known.
    """

    offset_cm: float = Field(default=0.42, gt=0.0)
    offset_share: float = Field(default=0.014, ge=0.0)
    slope: float = Field(default=0.023, gt=0.0)
    slope_per_rad: float = Field(default=0.057, ge=0.0)
    curvature_per_cm: float = Field(default=0.0021, gt=0.0)
    log_width: float = Field(default=0.01, gt=0.0)
    usual_step_cm: float = Field(default=3.0, ge=0.0)
    usual_turn_rad: float = Field(default=0.05, ge=0.0)
    unknown: float = Field(default=4.0, ge=1.0)


class NetworkWeight(Settings):
    """How much the network's answer says.

    Attributes:
        sigma_factor: On the sigmas of a hypothesis that begins with its answer.
        weight: Power of its probabilities: neighbouring rows and frames err alike.
        unseen_weight: Share of that weight where it sees no line.
        least_share: Probability of any place, added to each.
        window_cm: Least sigma of a hypothesis when it is compared.
        correlation: Of the errors of neighbouring rows.
        variance_cm2: Added to the variance of each mode.
    """

    sigma_factor: float = Field(default=2.0, gt=0.0)
    weight: float = Field(default=0.44, gt=0.0, le=1.0)
    unseen_weight: float = Field(default=0.3, ge=0.0, le=1.0)
    least_share: float = Field(default=1.3e-4, gt=0.0, lt=1.0)
    window_cm: float = Field(default=2.2, gt=0.0)
    correlation: float = Field(default=0.46, ge=0.0, lt=1.0)
    variance_cm2: float = Field(default=0.66, gt=0.0)


class BorderWeight(Settings):
    """How much the borders that edges show say.

    Attributes:
        prior_cm: Sigma that is added to a line before its borders are looked for.
        unseen_row: Factor on the sigma of a row beside which no border is.
        least_cm: Sigma of a line on its marking, at least.
        few_cm: Length of borders at which that sigma is 1.4 times as large; shorter ones count less.
        surprise: Squared distance, in sigmas, at which a line counts half as much: Student's t for a gate.
        seen_cm: Length of borders from which a line is seen.
        seen_share: Probability that 3 cm of a line show a border.
        clutter_share: Probability that 3 cm of anything else do.
        weight: Power of these probabilities: neighbouring places are seen together or not at all.
    """

    prior_cm: float = Field(default=0.2, ge=0.0)
    unseen_row: float = Field(default=3.4, ge=1.0)
    least_cm: float = Field(default=0.18, gt=0.0)
    few_cm: float = Field(default=10.3, ge=0.0)
    surprise: float = Field(default=1.2, gt=0.0)
    seen_cm: float = Field(default=9.0, ge=0.0)
    seen_share: float = Field(default=0.84, gt=0.0, lt=1.0)
    clutter_share: float = Field(default=0.076, gt=0.0, lt=1.0)
    weight: float = Field(default=0.072, gt=0.0, le=1.0)


class HypothesisWeights(Settings):
    """How hypotheses compete; log weights are natural logarithms.

    Attributes:
        surprise: Probability that a frame is an outlier, which tells nothing: no frame alone decides.
        kept: Forgetting factor of the log weights.
        born: Log weight of one that begins with the network's answer, beside the best.
        beside: Log weight of the next lane, beside the one that the car is in.
        beside_cm: Standard deviation of where the next lane is, beside that of the lane that the car is in.
        any_offset_lanes: Standard deviation of the offset of a lane that was not known, in lane widths.
        any_slope: Of its slope.
        any_curvature: Of its curvature, [1/cm].
        near_lanes: Distance from a line within which the next lane is looked at, in lane widths.
        inside_cm: Sigma of where the front axle is: the car is in the lane that it is over.
        same_lanes: Lanes whose lines are nearer than this are one, in lane widths.
        least: Log weight below which a hypothesis is dropped.
        most: Number of hypotheses.
        width_sigma: Standard deviation of a lane's log width about the one that is known.
    """

    surprise: float = Field(default=0.3, gt=0.0, lt=1.0)
    kept: float = Field(default=0.84, ge=0.0, le=1.0)
    born: float = Field(default=-5.0, le=0.0)
    beside: float = Field(default=-5.5, le=0.0)
    beside_cm: float = Field(default=2.0, gt=0.0)
    any_offset_lanes: float = Field(default=0.6, gt=0.0)
    any_slope: float = Field(default=0.4, gt=0.0)
    any_curvature: float = Field(default=0.02, gt=0.0)
    near_lanes: float = Field(default=0.25, ge=0.0)
    inside_cm: float = Field(default=3.0, gt=0.0)
    same_lanes: float = Field(default=0.12, gt=0.0, lt=0.5)
    least: float = Field(default=-7.0, lt=0.0)
    most: int = Field(default=6, ge=1)
    width_sigma: float = Field(default=0.046, gt=0.0)


class DoubtWeights(Settings):
    """Standard deviation of an answer: the root of a sum of squares, each of a part times its weight.

    Attributes:
        rivals: Standard deviation of the hypotheses about the best one.
        own: Standard deviation of the hypotheses themselves.
        unseen_cm: Share, 0 to 1, of a line in view that shows no border, of the line that is seen better.
        neither_cm: The same times the probability that the network sees neither line. Of such points of 150
            drives half are more than 2.9 cm off.
        beyond: Distance beyond the last border of both lines.
        apart: Distance to the network's own answer at the point.
        apart_ahead: The same of the line 15 cm ahead.
        network: The network's sigma.
        most_lanes: A point with a larger standard deviation than this is unknown, in lane widths; no weight.
    """

    rivals: float = Field(default=0.58, ge=0.0)
    own: float = Field(default=0.58, ge=0.0)
    unseen_cm: float = Field(default=0.75, ge=0.0)
    neither_cm: float = Field(default=4.0, ge=0.0)
    beyond: float = Field(default=0.05, ge=0.0)
    apart: float = Field(default=0.36, ge=0.0)
    apart_ahead: float = Field(default=0.31, ge=0.0)
    network: float = Field(default=0.25, ge=0.0)
    most_lanes: float = Field(default=0.065, gt=0.0)

    @property
    def weights(self) -> tuple[float, ...]:
        """Weights of the parts, in the order of :data:`lanenet.perception.network.lane.filter.PARTS`."""
        return tuple(self.model_dump().values())[:-1]


class LaneFilterSettings(Settings):
    """All numbers of the lane filter.

    Attributes:
        shape_cm: By what a line differs from the state's curve at the front axle, as a standard deviation.
        shape_per_cm: By how much that grows per cm ahead.
        bend_per_cm: The same where no border of the line is seen: it may turn there.
        motion: See :class:`MotionNoise`.
        network: See :class:`NetworkWeight`.
        borders: See :class:`BorderWeight`.
        hypotheses: See :class:`HypothesisWeights`.
        doubt: See :class:`DoubtWeights`.
    """

    shape_cm: float = Field(default=0.14, gt=0.0)
    shape_per_cm: float = Field(default=0.0077, ge=0.0)
    bend_per_cm: float = Field(default=0.025, ge=0.0)
    motion: MotionNoise = MotionNoise()
    network: NetworkWeight = NetworkWeight()
    borders: BorderWeight = BorderWeight()
    hypotheses: HypothesisWeights = HypothesisWeights()
    doubt: DoubtWeights = DoubtWeights()
