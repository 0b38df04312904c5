"""Frames that come at uneven times: a recorder that is busy misses some images, then gets two at once.

The recorded times do not tell. An image that hardly differs from the one before it, amid others that do,
does. Around such frames the length of every step is measured by itself, in typical steps.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from datagen.slam.commands import GAP_PERIODS
from datagen.slam.odometry.edge_motion import edge_shift_px
from datagen.slam.odometry.image_pairs import ImagePairs, turns_up_to
from lanenet.data.drives import Drive
from lanenet.processes import in_threads

#: Share of the shift of the images around it below which an image came too early, and how many are around it
#: on either side. Measured: 15 frames of 1070 on ``blue_tape``; none on ``garage_tape`` and
#: ``donkey_circuit``; on ``usi_mat`` some at which the car sets off or comes to rest.
_EARLY, _AROUND = 0.25, 3
#: Steps that are tried, relative to the typical one; and their spread about it, as a logarithm. Measured on
#: ``blue_tape``: a tenth of a step, after one of two to three.
_STEPS, _SPREAD = np.exp(np.linspace(np.log(0.1), np.log(3.0), 25)), 1.5
#: Steps that are as good as typical ones: speed varies as much. After a longer one, an early image follows a
#: miss; after another, the car comes to rest or sets off.
_EVEN = (0.7, 1.4)


def early_frames(drive: Drive) -> Bool[np.ndarray, "n"]:
    """Find the frames that hardly differ from the one before, though those around them do."""
    n = len(drive)
    shift_px = np.full(n, np.nan)
    after = drive.image(0)
    for k in range(1, n):
        before, after = after, drive.image(k)
        shift_px[k] = edge_shift_px(before, after)
    early = np.zeros(n, dtype=bool)
    for k in range(1 + _AROUND, n - _AROUND):
        around = np.concatenate([shift_px[k - _AROUND : k], shift_px[k + 1 : k + 1 + _AROUND]])
        early[k] = shift_px[k] < _EARLY * np.median(around)
    return early


def measured_periods(
    images: ImagePairs, step_heights: float, early: Bool[np.ndarray, "n"]
) -> tuple[Float[np.ndarray, "n"], Bool[np.ndarray, "n"]]:
    """Measure the time before each frame near early ones.

    Args:
        images: The drive.
        step_heights: Its typical step length.
        early: See :func:`early_frames`.

    Returns:
        Times in typical time steps, 1 where they are even; and where they are uneven, or may be.
    """
    near = np.convolve(early, np.ones(2 * _AROUND + 1), mode="same") > 0.5
    frames = np.flatnonzero(near & (images.periods <= GAP_PERIODS))
    frames = frames[frames > 0]
    s, even = images.settings, np.ones(len(images))
    turns_rad = turns_up_to(s.max_curvature_heights * step_heights, images.turn_step_rad)
    usual = -0.5 * (np.log(_STEPS) / _SPREAD) ** 2

    def period_of(k: int) -> float:
        fit = images.fit(k, _STEPS * step_heights, turns_rad, even, s.lags[:1])
        likely = s.temper * len(s.lags) * fit.max(axis=1) + usual
        return float(_STEPS[int(np.argmax(likely))])

    found = np.ones(len(images))
    found[frames] = list(in_threads(period_of, frames.tolist()))
    missed = early & (found < _EVEN[0]) & (np.roll(found, 1) > _EVEN[1])
    uneven = np.zeros(len(images), dtype=bool)
    uneven[frames] = np.convolve(missed, np.ones(2 * _AROUND + 1), mode="same")[frames] > 0.5
    other = uneven & ((found <= _EVEN[0]) | (found >= _EVEN[1]))
    return np.where(other, found, 1.0), uneven
