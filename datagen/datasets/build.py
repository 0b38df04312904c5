"""The label sets of a training run: what is missing is made, one job per drive.

Training and validation labels come from maps; the simulator's truth only scores the result.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from datagen.datasets.from_library import with_library
from datagen.datasets.jobs import (
    CompileJob,
    Job,
    LeftOut,
    Part,
    RecordedJob,
    SyntheticJob,
    run_job,
)
from datagen.datasets.leaks import refuse_leaks
from datagen.datasets.settings import ROLES, DataSettings, Role
from lanenet.data.library import DEFAULT_LIBRARY
from lanenet.data.maps.joined import is_joined, maps_in
from lanenet.errors import ConfigError, TrackingLostError
from lanenet.processes import Progress, run_jobs


@dataclass(frozen=True)
class PreparedData:
    """Label sets of a run.

    Attributes:
        parts: All of them.
        camera: Camera file, where all drives share one camera.
        example: A frame of a synthetic test drive, to try the model on.
        left_out: Synthetic drives that have no labels, and why.
    """

    parts: tuple[Part, ...]
    camera: Path | None
    example: Path | None
    left_out: tuple[str, ...] = ()

    def of(self, role: Role) -> list[Part]:
        """Return the label sets of a role."""
        return [part for part in self.parts if part.role == role]

    @property
    def train(self) -> list[Path]:
        """Label sets to learn from; a recording that counts as several drives is listed as often."""
        return [part.labels for part in self.of("train") for _ in range(part.counts_as)]

    @property
    def weights(self) -> list[float]:
        """How often each of :attr:`train` is shown beside the others."""
        return [part.weight for part in self.of("train") for _ in range(part.counts_as)]

    @property
    def validation(self) -> list[Path]:
        """Label sets to choose the epoch by."""
        return [part.labels for part in self.of("validation")]


def prepare(
    settings: DataSettings,
    work_dir: Path,
    progress: Progress | None = None,
    last: Callable[[Path], object] | None = None,
) -> PreparedData:
    """Make the label sets that do not exist yet.

    Each drive is one job in its own process. What a job has finished stays, so that a killed run resumes. A
    label set is made again when its settings have changed.

    Args:
        settings: The data of a run.
        work_dir: Folder for drives, maps and label sets.
        progress: Called with (jobs done, jobs).
        last: Called with a training label set, in a process that would be idle while others finish the last
            synthetic drives: compiles what the training needs. A function of a module.

    Raises:
        ConfigError: If there is nothing to learn from or to choose the epoch by, or drives of different parts
            share frames or a track.
        TrackingLostError: If more drives fail than may.
        LanenetError: What the first failing job raised; or that its process died, naming the drive.
    """
    settings, _ = with_library(settings)
    synthetic = settings.synthetic
    jobs: list[Job] = [
        SyntheticJob.draw(settings, role, number, work_dir)
        for role in ROLES
        for number in range(getattr(synthetic, role))
    ]
    jobs += recorded_jobs(settings, work_dir)
    roles: tuple[Role, ...] = ("train", "validation")
    for role in roles:
        if not any(role in drive.parts for drive in settings.drives) and not getattr(synthetic, role):
            raise ConfigError(
                f"data: no {role} drives; set data.synthetic.{role}, or list data.drives that are split, or "
                f"whole ones of it (split: {role})"
            )
    check_leaks(settings, work_dir)
    # The first drive that is mapped compiles what all others use. The test drives, which need little of that,
    # run beside it, so that no second process compiles the same.
    jobs[1:] = sorted(jobs[1:], key=lambda job: not (isinstance(job, SyntheticJob) and job.role == "test"))
    learned = tuple(job.labels for job in jobs if isinstance(job, SyntheticJob) and job.role == "train")
    if last is not None and learned:
        jobs.append(CompileJob(last, learned))
    results = run_jobs(run_job, [(job.title, job) for job in jobs], settings.processes, progress)
    left_out = [
        f"{job.title}: {result.reason}"
        for job, result in zip(jobs, results, strict=True)
        if isinstance(result, LeftOut)
    ]
    mapped = synthetic.train + synthetic.validation
    if len(left_out) > synthetic.may_fail * mapped:
        raise TrackingLostError(
            f"{len(left_out)} of {mapped} synthetic drives to be mapped give no labels, expected at most "
            f"{synthetic.may_fail * mapped:.0f} (data.synthetic.may_fail); the first: {left_out[0]}"
        )
    test = _first_drive(jobs, "test")
    images = [] if test is None else sorted((test / "images").glob("*.jpg"))
    return PreparedData(
        parts=tuple(part for result in results if not isinstance(result, LeftOut) for part in result),
        camera=shared_camera(settings, jobs),
        example=images[len(images) // 2] if images else None,
        left_out=tuple(left_out),
    )


def recorded_jobs(settings: DataSettings, work_dir: Path) -> list[RecordedJob]:
    """Return the jobs of the recorded drives of a run, whose maps can be made before the rest.

    Joined maps have a job for each of their drives.
    """
    jobs = []
    for drive in settings.drives:
        paths = maps_in(drive.path)
        for path in paths:
            # Those of a folder that is listed as a whole have its title, each with its own name.
            name = f"{drive.name}/{path.name}" if drive.name and len(paths) > 1 else drive.name
            one = drive.model_copy(update={"path": path, "name": name})
            alone = _joined_in(path) if paths == [drive.path] else None
            jobs.append(RecordedJob(one, settings, work_dir / "drives", alone))
    return jobs


def _joined_in(path: Path) -> Path | None:
    """Return the folder of joined maps that a map lies in; None if it lies in none."""
    folder = path.resolve().parent
    return folder if is_joined(folder) and path.resolve() in maps_in(folder) else None


def check_leaks(
    settings: DataSettings, work_dir: Path, progress: Callable[[str, int, int], object] | None = None
) -> tuple[str, ...]:
    """Refuse drives of which one is learned from and another, of the same recording or track, judged by.

    Args:
        settings: The data of a run.
        work_dir: As for :func:`prepare`.
        progress: Called with (stage, done, total).

    Returns:
        What could not be checked, for people.

    Raises:
        LanenetError: As :func:`datagen.datasets.leaks.refuse_leaks`.
    """
    library = settings.known_drives or (DEFAULT_LIBRARY if DEFAULT_LIBRARY.is_file() else None)
    folder = work_dir / "drives" / "leaks"
    return refuse_leaks(recorded_jobs(settings, work_dir), folder, progress, library)


def shared_camera(settings: DataSettings, jobs: Sequence[Job]) -> Path | None:
    """Return the camera file of the run's drives, if they share one: the simulation's, or a recording's.

    Where every synthetic drive has its own camera, that of the first test drive, which the example is from.
    """
    recorded = [job for job in jobs if isinstance(job, RecordedJob)]
    if settings.synthetic.variety == "all":
        owner = _first_drive(jobs, "test")
    else:
        owner = None if recorded else _first_drive(jobs, "train")
    if len(recorded) == 1 and not any(isinstance(job, SyntheticJob) for job in jobs):
        return recorded[0].camera_file()
    return None if owner is None else owner / "camera.yaml"


def _first_drive(jobs: Sequence[Job], role: Role) -> Path | None:
    """Folder of the first synthetic drive of a role, if there is one."""
    return next((job.drive for job in jobs if isinstance(job, SyntheticJob) and job.role == role), None)
