"""What parts of the lane filter are worth: ``make ablation``.

Simulated drives that no network has learned from are answered by the whole filter and without one part at a
time, open loop: the width is given, and the motion as it was commanded. The answers of a drive are kept in a
file as soon as they are there, so that a run that was killed goes on where it stopped. At the end: wrong
decisions and errors of each variant, and the difference to the whole filter, paired by drive; and the
modules that one plain frame passes.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float
from rich.console import Console

from datagen.datasets.jobs import SyntheticJob
from datagen.world.simulate import draw_state, scripted_states
from datagen.world.variety import first_world
from datagen.world.world import World
from lanenet.cli.train import run_settings_schema
from lanenet.config import load_settings
from lanenet.data.drives import Commands
from lanenet.data.drives.motion import motion_of_commands
from lanenet.data.maps.mapped_drive import LabelledFrames
from lanenet.errors import ConfigError
from lanenet.evaluation.answers import answer_frames
from lanenet.evaluation.decisions import Decisions, decide
from lanenet.evaluation.tables import TextTable
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.perception.edges.road import PerceptionSettings
from lanenet.perception.network.detector import NetworkDetector
from lanenet.perception.network.lane.filter import LaneFilter
from lanenet.perception.network.lane.lines import LineFinder
from lanenet.perception.network.lane.marking_widths import MarkingWidths

ROOT = Path(__file__).parents[2]
#: Seeds the drives, with their number; figures of other seeds count.
SEED = 520_000
#: What is added to a drive's number where its car cannot drive its road. Chosen: beyond all numbers.
ANOTHER = 100_000
_RESAMPLES = 2000
Part = tuple[Any, str, Callable[..., Any]]


#: What is replaced by what, by the name of the part.
PARTS: dict[str, list[Part]] = {
    "borders that are seen or not": [
        (LineFinder, "log_likelihood", lambda _, lines: np.zeros(len(lines[0])))
    ],
    "where the axle is": [(LaneFilter, "_log_inside", lambda _, points_cm: np.zeros(len(points_cm)))],
    "the next lane": [(LaneFilter, "_beside", lambda *_: None)],
    "widths of markings": [(MarkingWidths, "usual_cm", lambda *_: None)],
    "other hypotheses": [(LaneFilter, "_distinct", lambda _, points_cm, __, inside: inside.argsort()[-1:])],
}
WHOLE, NO_MOTION, SINGLE = "whole", "motion", "memory"
VARIANTS = (WHOLE, NO_MOTION, SINGLE, *PARTS)


@contextmanager
def without(variant: str) -> Iterator[None]:
    """Leave out a part of the filter."""
    kept = [(where, name, getattr(where, name)) for where, name, _ in PARTS.get(variant, [])]
    try:
        for where, name, stand_in in PARTS.get(variant, []):
            setattr(where, name, stand_in)
        yield
    finally:
        for where, name, own in kept:
            setattr(where, name, own)


def drawn(seed: int, number: int) -> World:
    """Build the world of a drive like those that the general network was tested on, of another seed."""
    data = load_settings(run_settings_schema(), ROOT / "configs/general.yaml").data  # type: ignore[attr-defined]
    data = data.model_copy(update={"synthetic": data.synthetic.model_copy(update={"seed": seed})})
    while True:
        try:
            return first_world(SyntheticJob.draw(data, "test", number, Path()).simulation)
        except ConfigError:  # a road that this car cannot drive
            number += ANOTHER


def frames_of(world: World, name: str) -> LabelledFrames:
    """Let the driver drive, and draw what the camera sees."""
    states = list(scripted_states(world))
    images = [draw_state(world.renderer, state) for state in states]
    starts = np.arange(len(states)) == 0
    commands = Commands(
        speed_cm_s=np.array([state.speed_cm_s for state in states]),
        steering_rad=np.array([state.steering_rad for state in states]),
    )
    t_s, points_cm = (np.array([getattr(state, key) for state in states]) for key in ("t_s", "points_cm"))
    window = BirdseyeWindow()
    return LabelledFrames(
        name=name,
        reference="truth",
        camera=world.camera,
        lane_width_cm=world.track.lane_width_cm,
        marking_cm=None,
        perception=PerceptionSettings(),
        frames=np.arange(len(states)),
        starts=starts,
        points_cm=np.array([window.labelled(points) for points in points_cm]),
        image=images.__getitem__,
        motion=motion_of_commands(commands, t_s, starts, world.camera.wheelbase_cm),
    )


def answer(model: Path, seed: int, number: int, path: Path) -> Path:
    """Write the answers of all variants to a drive, unless they are there."""
    if path.exists():
        return path
    cv2.setNumThreads(1)
    frames = frames_of(drawn(seed, number), path.stem)
    found = {"known_cm": frames.points_cm.astype(np.float32)}
    for variant in VARIANTS:
        told = replace(frames, motion=None) if variant == NO_MOTION else frames
        with without(variant):
            detector = NetworkDetector(
                model,
                frames.camera,
                any_camera=True,
                lane_width_cm=frames.lane_width_cm,
                keeps=variant != SINGLE,
            )
            answers = answer_frames(told, {"it": detector})
        found[f"{variant} cm"] = answers.points_cm["it"].astype(np.float32)
        found[f"{variant} sigma"] = answers.sigma_cm["it"].astype(np.float32)
    temporary = path.with_suffix(".tmp.npz")
    np.savez_compressed(temporary, **found)  # type: ignore[arg-type]
    temporary.replace(path)
    return path


def table_of(paths: list[Path]) -> TextTable:
    """Compare the variants over the drives that were answered."""
    drives = [dict(np.load(path)) for path in sorted(paths)]
    frames = np.array([len(drive["known_cm"]) for drive in drives])
    cuts, known_cm = np.cumsum(frames)[:-1], np.concatenate([drive["known_cm"] for drive in drives])
    lines, whole = [], np.zeros(0)
    for variant in VARIANTS:
        own_cm, sigma_cm = (
            np.concatenate([drive[f"{variant} {what}"] for drive in drives]) for what in ("cm", "sigma")
        )
        found = decide(own_cm, known_cm, sigma_cm, cuts, cuts)
        by_drive = _squares_by_drive(own_cm, known_cm, cuts)
        whole = by_drive if variant == WHOLE else whole
        difference = "" if variant == WHOLE else "{:+.2f} to {:+.2f}".format(*_paired(by_drive, whole))
        answered = np.isfinite(own_cm)[np.isfinite(known_cm)].mean()
        lines.append([variant, *_cells(found), f"{100.0 * answered:.1f}", difference])
    return TextTable(
        title=f"The lane filter without a part, {len(drives)} drives, {frames.sum()} frames",
        header=[
            "without", "wrong lane", "events", "surely wrong", "events", "RMSE", "p99", "answered",
            "difference",
        ],
        lines=lines,
        note="per 1000 frames, and as events; errors in cm of frames that are not in a wrong lane; "
        "difference: 95 % interval of the RMSE over all answered points, less that of the whole filter, "
        "paired by drive",
    )  # fmt: skip


def _cells(found: Decisions) -> list[str]:
    kinds = found.wrong_lane, found.surely_wrong
    counts = [(f"{1000.0 * kind.frames / max(found.frames, 1):.2f}", str(kind.events)) for kind in kinds]
    return [*counts[0], *counts[1], f"{found.rmse_cm:.2f}", f"{found.p99_cm:.2f}"]


def _squares_by_drive(
    own_cm: Float[np.ndarray, "n 6"], known_cm: Float[np.ndarray, "n 6"], cuts: np.ndarray
) -> Float[np.ndarray, "d 2"]:
    """Return the sum of squared errors and their number, of each drive."""
    squares = [part**2 for part in np.split(np.asarray(own_cm - known_cm, np.float64), cuts)]
    return np.array([(np.nansum(part), np.isfinite(part).sum()) for part in squares])


def _paired(own: np.ndarray, whole: np.ndarray) -> list[float]:
    """Return the 95 % interval of the difference of two RMSE over the same drives."""
    n = len(own)
    times = np.random.default_rng(0).multinomial(n, np.full(n, 1.0 / n), _RESAMPLES)
    rmse = [np.sqrt((times @ each[:, 0]) / (times @ each[:, 1])) for each in (own, whole)]
    return np.percentile(rmse[0] - rmse[1], [2.5, 97.5]).tolist()


def path_of_a_frame(model: Path) -> str:
    """Say how many modules of ours a plain frame passes, and how often it goes from one to the next."""
    frames = frames_of(drawn(SEED, 0), "plain")
    detector = NetworkDetector(model, frames.camera, any_camera=True, lane_width_cm=frames.lane_width_cm)
    images = [frames.image(i) for i in range(20)]
    for image in images[:-1]:
        detector.detect(image)
    modules, moves = set(), 0

    def watch(frame: FrameType, event: str, _: Any) -> None:
        nonlocal moves
        name = str(frame.f_globals.get("__name__", ""))
        if event == "call" and name.startswith("lanenet."):
            modules.add(name)
            back = frame.f_back
            moves += back is not None and back.f_globals.get("__name__") != name

    sys.setprofile(watch)
    try:
        detector.detect(images[-1])
    finally:
        sys.setprofile(None)
    return f"one plain frame passes {len(modules)} modules with {moves} moves between them"


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, required=True, help="the answers are kept here")
    parser.add_argument("--model", type=Path, default=ROOT / "checkpoints/general")
    parser.add_argument("--drives", type=int, default=500)
    parser.add_argument("--seed", type=int, default=SEED, help="another seed needs another folder")
    parser.add_argument("--processes", type=int, default=1)
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    paths = [args.folder / f"{number:04d}.npz" for number in range(args.drives)]
    with ProcessPoolExecutor(args.processes) as pool:
        jobs = [pool.submit(answer, args.model, args.seed, n, path) for n, path in enumerate(paths)]
        for done, job in enumerate(as_completed(jobs), start=1):
            job.result()
            sys.stderr.write(f"\r{done} of {len(paths)} drives")
    sys.stderr.write("\n")
    Console(width=120).print(table_of(paths).as_rich())
    sys.stdout.write(path_of_a_frame(args.model) + "\n")


if __name__ == "__main__":
    main()
