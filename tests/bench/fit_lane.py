"""Fit the numbers of the lane filter: ``make fit-lane``.

Simulated drives are seen by the network once; its answers, the edges and the motion are then replayed through
the filter with other numbers. What is minimised is the negative log likelihood of the true points under the
answers: normal around them, or, with a small probability, anywhere. The weights of the doubt follow from the
rest by gradient descent in each trial. The study is kept in a file, so that a run that was killed goes on;
the best trials are compared on drives of another seed, which had no part in the fit.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import optuna
from bench_ablation import ROOT, drawn, frames_of
from jaxtyping import Float
from rich.progress import track
from scipy.optimize import minimize

from lanenet.config import Settings
from lanenet.perception.edges.road import RoadEdges
from lanenet.perception.estimate import LaneMemory
from lanenet.perception.network.detector import NetworkDetector
from lanenet.perception.network.lane.filter import PARTS, LaneAnswer, LaneFilter
from lanenet.perception.network.lane.network_answer import NetworkAnswer
from lanenet.perception.network.lane.settings import LaneFilterSettings
from lanenet.perception.network.lane.view import LinesInView

#: Seeds of the drives that are fitted to, and of those by which trials are chosen.
SEED, CHOICE_SEED = 530_000, 531_000
#: Share of points that may be anywhere in the window, and its width, [cm].
ANYWHERE, WINDOW_CM = 0.001, 100.0
#: How far from today's number each is looked for, as a factor.
REACH = 3.0
#: What stands for a rule of the search, not for a quantity of roads, is left as it is.
LEFT = (
    "borders.seen_cm", "doubt", "hypotheses.any_", "hypotheses.beside_cm", "hypotheses.least",
    "hypotheses.most", "hypotheses.near_lanes", "hypotheses.same_lanes", "motion.unknown", "motion.usual",
)  # fmt: skip
#: Best trials that are compared on the drives of the other seed.
COMPARED = 5


class Drive(NamedTuple):
    """What the filter takes of a drive, and the truth."""

    steps: list[tuple[NetworkAnswer, RoadEdges] | None]
    motion: Float[np.ndarray, "n 2"]
    view: LinesInView
    wheelbase_cm: float
    lane_cm: float
    true_cm: Float[np.ndarray, "n 6"]


class Recorder(LaneFilter):
    """Notes what the filter is given."""

    steps: list[tuple[NetworkAnswer, RoadEdges] | None]

    def follow(self, answer: NetworkAnswer, edges: RoadEdges) -> LaneAnswer:
        """Note a frame."""
        self.steps.append((answer, edges))
        return LaneAnswer.none("")

    def lose(self) -> None:
        """Note a frame that shows nothing."""
        self.steps.append(None)


def seen(model: Path, seed: int, number: int) -> Drive:
    """Show a drive to the network."""
    cv2.setNumThreads(1)
    frames = frames_of(drawn(seed, number), f"{number:04d}")
    width_cm = frames.lane_width_cm
    assert width_cm is not None and frames.motion is not None
    detector = NetworkDetector(model, frames.camera, any_camera=True, lane_width_cm=width_cm)
    view = LinesInView(frames.camera, detector._extractor.table.keep)
    recorder = Recorder(LaneMemory(width_cm), view)
    recorder.steps, detector._filter = [], recorder
    for index in range(len(frames.frames)):
        detector.detect(frames.image(index))
    motion = np.stack([frames.motion.travel_cm, frames.motion.turn_rad], axis=1)
    return Drive(recorder.steps, motion, view, frames.camera.wheelbase_cm, width_cm, frames.points_cm)


def filter_of(drive: Drive, settings: LaneFilterSettings | None = None) -> LaneFilter:
    """Return a filter for a drive that has seen none of it."""
    return LaneFilter(LaneMemory(drive.lane_cm), drive.view, settings=settings)


def replayed(drive: Drive, lane: LaneFilter) -> Iterator[tuple[int, LaneAnswer]]:
    """Yield the answers of a filter to a drive."""
    for number, step in enumerate(drive.steps):
        travel_cm, turn_rad = drive.motion[number].tolist()
        lane.moved(travel_cm, turn_rad, drive.wheelbase_cm)
        if step is None:
            lane.lose()
        else:
            yield number, lane.follow(*step)


def answered(drives: list[Drive], settings: LaneFilterSettings) -> tuple[np.ndarray, np.ndarray]:
    """Return errors and unweighted parts of the doubt of all points whose truth is known."""
    errors, doubts = [], []
    raw = settings.model_copy(update={"doubt": settings.doubt.model_copy(update={"most_lanes": np.inf})})
    for drive in drives:
        for number, answer in replayed(drive, filter_of(drive, raw)):
            off_cm = answer.points_cm - drive.true_cm[number]
            known = np.isfinite(off_cm)
            errors.append(off_cm[known])
            doubts.append(answer.doubts[known])
    return np.concatenate(errors), np.concatenate(doubts)


def nats(log_squares: np.ndarray, off_cm: np.ndarray, doubts: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the mean negative log likelihood, and its gradient by the logarithms of the weights squared."""
    squares = np.exp(log_squares)
    variance = doubts @ squares + 1e-4
    own = (1.0 - ANYWHERE) * np.exp(-0.5 * off_cm**2 / variance) / np.sqrt(2.0 * np.pi * variance)
    total = own + ANYWHERE / WINDOW_CM
    change = own / total * (0.5 / variance - 0.5 * (off_cm / variance) ** 2)
    return float(-np.log(total).mean()), doubts.T @ change / len(off_cm) * squares


def weighed(off_cm: np.ndarray, doubts: np.ndarray) -> tuple[float, np.ndarray]:
    """Fit the weights of the doubt; return the log likelihood and the weights."""
    start = np.log(np.square(LaneFilterSettings().doubt.weights))
    bounds = [(-12.0, 4.0)] * len(start)
    found = minimize(nats, start, (off_cm, doubts), jac=True, method="L-BFGS-B", bounds=bounds)
    return float(found.fun), np.exp(0.5 * found.x)


def numbers(settings: Settings, before: str = "") -> Iterator[tuple[str, float]]:
    """Yield the numbers that are fitted, by their dotted names."""
    for name in type(settings).model_fields:
        value, path = getattr(settings, name), f"{before}{name}"
        if path.startswith(LEFT):
            continue
        if isinstance(value, Settings):
            yield from numbers(value, f"{path}.")
        else:
            yield path, float(value)


def with_numbers(settings: LaneFilterSettings, changed: dict[str, float]) -> LaneFilterSettings:
    """Return settings with some numbers changed."""
    plain: dict[str, Any] = settings.model_dump()
    for path, value in changed.items():
        *where, name = path.split(".")
        into = plain
        for part in where:
            into = into[part]
        into[name] = value
    return LaneFilterSettings.model_validate(plain)


def objective(trial: optuna.Trial, drives: list[Drive]) -> float:
    """Return the negative log likelihood of one set of numbers."""
    drawn_numbers = {}
    for path, value in numbers(LaneFilterSettings()):
        size, bound = abs(value), _bound(path)
        most = size * REACH if bound is None or value < 0.0 else min(size * REACH, 0.98 * bound)
        drawn_numbers[path] = float(np.sign(value)) * trial.suggest_float(path, size / REACH, most, log=True)
    found, weights = weighed(*answered(drives, with_numbers(LaneFilterSettings(), drawn_numbers)))
    trial.set_user_attr("doubt", weights.round(4).tolist())
    return found


def _bound(path: str) -> float | None:
    """Return the upper bound of a number."""
    schema: Any = LaneFilterSettings
    for part in path.split("."):
        field = schema.model_fields[part]
        schema = field.annotation
    limits = [getattr(m, key) for m in field.metadata for key in ("le", "lt") if hasattr(m, key)]
    return limits[0] if limits else None


def main() -> None:
    """Fit, choose and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, required=True, help="the study is kept here")
    parser.add_argument("--model", type=Path, default=ROOT / "checkpoints/general")
    parser.add_argument("--drives", type=int, default=60)
    parser.add_argument("--trials", type=int, default=200)
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    drives, others = (
        [seen(args.model, seed, n) for n in track(range(args.drives), f"seed {seed}")]
        for seed in (SEED, CHOICE_SEED)
    )
    sampler = optuna.samplers.TPESampler(seed=0, multivariate=True, n_startup_trials=10)
    study = optuna.create_study(
        study_name="lane",
        storage=f"sqlite:///{args.folder / 'study.db'}",
        load_if_exists=True,
        sampler=sampler,
    )
    today = {path: abs(value) for path, value in numbers(LaneFilterSettings())}
    done = study.get_trials(states=[optuna.trial.TrialState.COMPLETE])
    if not any(trial.params == today for trial in done):
        study.enqueue_trial(today)
    left = args.trials - len(done)
    study.optimize(partial(objective, drives=drives), n_trials=max(left, 0), show_progress_bar=True)
    done = study.get_trials(states=[optuna.trial.TrialState.COMPLETE])
    best = sorted(done, key=lambda trial: trial.values[0])[:COMPARED]
    for trial in [*(trial for trial in done if trial.params == today), *best]:
        changed = {path: np.sign(value) * trial.params[path] for path, value in numbers(LaneFilterSettings())}
        off_cm, doubts = answered(others, with_numbers(LaneFilterSettings(), changed))
        chosen = nats(np.log(np.square(trial.user_attrs["doubt"])), off_cm, doubts)[0]
        sigma = np.sqrt(doubts @ np.square(trial.user_attrs["doubt"]))
        held = [f"{(np.abs(off_cm) < k * sigma).mean():.3f}" for k in (1.0, 2.0)]
        said = f"other seed {chosen:.4f}; one and two sigma hold {' and '.join(held)}"
        sys.stdout.write(f"trial {trial.number}: {trial.value:.4f} nats a point, {said}\n")
        sys.stdout.write(f"{ {path: float(f'{value:.3g}') for path, value in changed.items()} }\n")
        sys.stdout.write(f"doubt {dict(zip(PARTS, trial.user_attrs['doubt'], strict=True))}\n")


if __name__ == "__main__":
    main()
