"""Drives on a cluster whose machines are killed meanwhile, against one process (``make fleet``)."""

from __future__ import annotations

import random
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from fleet_drives import cut_tub, simulated_drives, sixty_drives

from datagen.fleet.checksums import with_checksums
from datagen.fleet.local_engine import LocalEngine
from datagen.fleet.ray_engine import RayEngine
from datagen.fleet.run import label_all
from datagen.fleet.stage import Counts
from datagen.fleet.storage import RESULT_NAME, Storage
from datagen.fleet.task import FleetDrive, FleetSettings

pytestmark = pytest.mark.slow

#: Seed of when a machine is killed, and which.
SEED = 26
KINDS = ("maps", "labels", "cameras", "tracks")


class TwoMachines:
    """A head node that works on nothing, and two that have a core each; either may be killed."""

    def __init__(self) -> None:
        from ray.cluster_utils import Cluster

        head = {"num_cpus": 0, "include_dashboard": False}
        self.cluster = Cluster(initialize_head=True, head_node_args=head)
        self.nodes, self.killed = [self.cluster.add_node(num_cpus=1) for _ in range(2)], 0

    def kill_one(self, place: int, after_s: float) -> None:
        """End all processes of one machine at once, amid a drive, and put another in its place."""
        time.sleep(after_s)
        self.cluster.remove_node(self.nodes[place], allow_graceful=False)
        self.killed += 1
        self.nodes[place] = self.cluster.add_node(num_cpus=1)


@pytest.fixture
def machines(monkeypatch: pytest.MonkeyPatch) -> Iterator[TwoMachines]:
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    # Else its workers have a niceness of 15, and hardly a core where others load the machine.
    monkeypatch.setenv("RAY_worker_niceness", "0")
    two = TwoMachines()
    yield two
    two.cluster.shutdown()


def contents(out: Path) -> dict[str, bytes]:
    """Return what was made, by path; not the markers, which tell when and where."""
    files = [path for kind in KINDS for path in (out / kind).rglob("*") if path.is_file()]
    # Joined maps name those that they were made from by their place, and the marker of a map the file of its
    # camera by place and time.
    other = (RESULT_NAME, "joined.yaml", "map.done.json")
    return {str(path.relative_to(out)): path.read_bytes() for path in files if path.name not in other}


@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_sixty_drives_on_two_machines_of_which_three_are_killed(
    shared_data: Path, tmp_path: Path, machines: TwoMachines, capsys: pytest.CaptureFixture[str]
) -> None:
    same_as_alone(sixty_drives(shared_data, tmp_path / "drives"), 3, tmp_path, machines, capsys)


@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_simulated_drives_on_two_machines_of_which_one_is_killed(
    tmp_path: Path, machines: TwoMachines, capsys: pytest.CaptureFixture[str]
) -> None:
    same_as_alone(simulated_drives(6, tmp_path / "drives"), 1, tmp_path, machines, capsys)


def same_as_alone(
    drives: list[FleetDrive],
    kills: int,
    tmp_path: Path,
    machines: TwoMachines,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Label drives on a cluster with kills, and again, and in one process: all is done once and alike."""
    count = len(drives)
    storage, settings = Storage(str(tmp_path / "cluster")), FleetSettings()
    checked = with_checksums(drives, storage)
    rng = random.Random(SEED)
    # Neither before the machines are at work nor when the rest is.
    kill_at = rng.sample(range(max(1, count // 20), count - count // 6), kills)

    def maybe_kill(counts: Counts) -> None:
        if counts.ended in kill_at:
            machines.kill_one(rng.randrange(2), rng.uniform(0.0, 2.0))

    engine = RayEngine(machines.cluster.address)
    with ThreadPoolExecutor(1) as meanwhile:
        in_one_process = meanwhile.submit(
            label_all, checked, settings, Storage(str(tmp_path / "alone")), LocalEngine(1)
        )
        begun_s = time.monotonic()
        result = label_all(checked, settings, storage, engine, maybe_kill)
        took_s = time.monotonic() - begun_s
        alone = in_one_process.result()
    assert machines.killed == kills
    verdicts = Counter(drive.verdict for drive in result.drives)
    assert set(verdicts) <= {"good", "usable", "reject", "refused"} and verdicts["good"] > 0, verdicts
    assert verdicts.total() == count and all(drive.new for drive in result.drives)

    # None is there twice, and nothing else is there.
    with_map = {drive.map_key for drive in result.drives}
    with_labels = {drive.labels_key for drive in result.drives if drive.labelled is not None}
    assert {path.name for path in (tmp_path / "cluster" / "maps").iterdir()} == with_map
    assert {path.name for path in (tmp_path / "cluster" / "labels").iterdir()} == with_labels
    assert len(with_map) == count

    begun_s = time.monotonic()
    again = label_all(with_checksums(drives, storage), settings, storage, engine)
    again_s = time.monotonic() - begun_s
    assert not any(drive.new for drive in again.drives) and again_s < 10.0
    assert [drive.verdict for drive in again.drives] == [drive.verdict for drive in result.drives]

    assert [drive.verdict for drive in alone.drives] == [drive.verdict for drive in result.drives]
    assert contents(tmp_path / "cluster") == contents(tmp_path / "alone")
    said = f"{count} drives, {dict(verdicts)}: {took_s:.0f} s with {kills} kills; again {again_s:.2f} s"
    with capsys.disabled():
        print(f"\n{said}")  # noqa: T201


@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_the_camera_of_a_car_and_the_map_of_a_track_are_the_same_from_processes_and_from_ray(
    shared_data: Path, tmp_path: Path
):
    told = {"wheelbase_cm": 17.0, "car": "red", "track": "garage"}
    drives = []
    for name, first in (("monday", 0), ("tuesday", 750)):
        cut = cut_tub(shared_data / "garage_tape", tmp_path / "drives" / name, first, 600)
        drives.append(FleetDrive(name, str(cut), "", 31.0, **told))
    results = []
    for name, engine in (("local", LocalEngine(2)), ("ray", RayEngine(None, 2))):
        storage = Storage(str(tmp_path / name))
        checked = with_checksums(drives, storage)
        results.append(label_all(checked, FleetSettings(), storage, engine))
        again = label_all(checked, FleetSettings(), storage, engine)
        assert not any(drive.new for drive in again.drives)
    local, on_ray = results
    (car,), (track,) = local.cars, local.tracks
    assert set(car.from_drives) == {"monday", "tuesday"} and not car.own
    assert track.joined == ("monday", "tuesday") and not track.left_out and not track.relaid
    assert [drive.verdict for drive in local.drives] == [drive.verdict for drive in on_ray.drives]
    assert [drive.map_key for drive in local.drives] == [drive.map_key for drive in on_ray.drives]
    assert on_ray.tracks == local.tracks
    assert contents(tmp_path / "local") == contents(tmp_path / "ray")
