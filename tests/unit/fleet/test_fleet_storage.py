"""The storage of results: whole or not at all, in a folder and in an object store."""

from __future__ import annotations

import json
import uuid
from collections.abc import Iterator
from pathlib import Path

import fsspec
import pytest

from datagen.fleet.storage import RESULT_NAME, Storage, local_path
from lanenet.errors import LanenetError


@pytest.fixture(params=["file", "memory"])
def storage(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Storage]:
    if request.param == "file":
        yield Storage(str(tmp_path / "out"))
        return
    url = f"memory://{uuid.uuid4().hex}"
    yield Storage(url)
    memory = fsspec.filesystem("memory")
    if memory.exists(url):
        memory.rm(url, recursive=True)


def fill(storage: Storage, key: str, text: str = "data", marked: bool = True) -> None:
    with storage.new("maps", key) as folder:
        (folder / "inside").mkdir()
        (folder / "inside" / "data.txt").write_text(text)
        if marked:
            (folder / RESULT_NAME).write_text(json.dumps({"says": text}))


def files_of(storage: Storage) -> list[str]:
    system, root = fsspec.core.url_to_fs(storage.url)
    return sorted(file.removeprefix(root) for file in system.find(root)) if system.exists(root) else []


def test_what_was_filled_is_finished_and_can_be_read(storage: Storage):
    assert storage.finished("maps") == set() and storage.result("maps", "a") is None
    fill(storage, "a")
    assert storage.finished("maps") == {"a"} and storage.finished("labels") == set()
    assert storage.result("maps", "a") == {"says": "data"}
    assert storage.results("maps", ["a"]) == {"a": {"says": "data"}}
    assert storage.read("maps", "a", "inside/data.txt") == b"data"
    assert storage.read("maps", "a", "missing") is None
    with storage.fetched("maps", "a") as folder:
        assert (folder / "inside" / "data.txt").read_text() == "data"
    assert files_of(storage) == ["/maps/a/inside/data.txt", "/maps/a/result.json"]


def test_an_error_leaves_nothing(storage: Storage):
    def fail() -> None:
        with storage.new("maps", "a") as folder:
            (folder / RESULT_NAME).write_text("{}")
            raise ValueError

    with pytest.raises(ValueError):
        fail()
    assert storage.finished("maps") == set() and files_of(storage) == []


@pytest.mark.parametrize("storage", ["memory"], indirect=True)
def test_the_marker_of_an_object_store_is_written_last(storage: Storage, monkeypatch: pytest.MonkeyPatch):
    memory, put = type(fsspec.filesystem("memory")), []
    original = memory.put_file
    monkeypatch.setattr(memory, "put_file", lambda s, a, b: (put.append(b), original(s, a, b))[1])
    fill(storage, "a")
    assert len(put) == 2 and put[-1].endswith(RESULT_NAME)


def test_the_first_of_two_workers_stays(storage: Storage):
    with storage.new("maps", "a") as folder:
        (folder / RESULT_NAME).write_text('{"says": "late"}')
        fill(storage, "a", "first")
    if storage.folder is not None:
        assert storage.result("maps", "a") == {"says": "first"}
    # Both are whole, and there is one of them.
    assert storage.finished("maps") == {"a"}
    assert files_of(storage) == ["/maps/a/inside/data.txt", "/maps/a/result.json"]


DONE, OTHER, BEGUN = (letter * 16 for letter in "abc")


def put(storage: Storage, *paths: str) -> None:
    system, root = fsspec.core.url_to_fs(storage.url)
    for path in paths:
        system.makedirs(f"{root}/{path}".rpartition("/")[0], exist_ok=True)
        system.pipe_file(f"{root}/{path}", b"{}")


def test_sweeping_removes_what_was_begun_and_keeps_what_is_finished(storage: Storage):
    storage.claim()
    fill(storage, DONE)
    fill(storage, OTHER)
    # As a killed worker leaves it: under a temporary name, or without a marker; and a lock.
    new = f"new-{BEGUN}-0123abcd"
    put(storage, f"maps/.{new}/result.json", f"maps/{BEGUN}/labels.parquet", f"maps/..{new}.lock")
    assert storage.finished("maps") == {DONE, OTHER}
    storage.sweep("maps")
    assert {file.split("/")[2] for file in files_of(storage) if "maps" in file} == {DONE, OTHER}
    storage.sweep("maps", {OTHER, "never there"})
    assert storage.finished("maps") == {DONE}
    storage.sweep("labels")


def test_sweeping_leaves_what_others_put_there(storage: Storage, tmp_path: Path):
    storage.claim()
    fill(storage, DONE)
    mine = ["maps/holiday.jpg", "maps/2024/photo.jpg", "maps/result.json", "maps/.new-idea/a.txt"]
    put(storage, *mine)
    if storage.folder is not None:
        (tmp_path / "far").mkdir()
        (tmp_path / "far" / "a.txt").write_text("far")
        # By the name of a result, which never is a link.
        (storage.folder / "maps" / OTHER).symlink_to(tmp_path / "far")
    storage.sweep("maps", {OTHER})
    assert {f"/{path}" for path in mine} <= set(files_of(storage))
    if storage.folder is not None:
        assert (storage.folder / "maps" / OTHER / "a.txt").read_text() == "far"


def test_a_folder_with_files_of_others_is_not_claimed(storage: Storage):
    put(storage, f"maps/{BEGUN}/photo.jpg")
    for use in (storage.claim, lambda: storage.write("index.html", b"")):
        with pytest.raises(LanenetError, match=r"has maps, which .* did not make .*nothing is written"):
            use()
    storage.sweep("maps", {BEGUN})
    assert files_of(storage) == [f"/maps/{BEGUN}/photo.jpg"]
    # As the message says, for what an earlier version made.
    put(storage, "fleet.yaml")
    with pytest.raises(LanenetError, match=r"has maps, fleet\.yaml"):
        storage.claim()
    storage.sweep("maps")
    assert f"/maps/{BEGUN}/photo.jpg" in files_of(storage)
    system, root = fsspec.core.url_to_fs(storage.url)
    system.pipe_file(f"{root}/fleet.yaml", b"format: lanenet-fleet/1")
    storage.claim()
    storage.sweep("maps")
    assert files_of(storage) == ["/fleet.yaml"]


def test_other_names_beside_the_own_ones_do_not_matter(tmp_path: Path):
    (tmp_path / "tub").mkdir()
    (tmp_path / "tub" / "manifest.json").touch()
    (tmp_path / "maps").mkdir()  # empty
    storage = Storage(str(tmp_path))
    storage.claim()
    assert storage.is_marked
    (tmp_path / "fleet.yaml").unlink()
    (tmp_path / "labels").symlink_to(tmp_path / "gone")
    with pytest.raises(LanenetError, match="has labels,"):
        storage.claim()


def test_files_beside_the_results(storage: Storage):
    storage.write("drives.json", b"one")
    storage.write("drives.json", b"two")
    assert storage.read("drives.json") == b"two" and storage.finished("maps") == set()


@pytest.mark.parametrize("torn", [b"", b'{"says": "da', b"\0" * 20, b"[" * 100_000, b"5"])
def test_a_torn_marker_is_none(storage: Storage, torn: bytes):
    storage.claim()
    fill(storage, DONE)
    fill(storage, OTHER)
    system, root = fsspec.core.url_to_fs(storage.url)
    system.pipe_file(f"{root}/maps/{OTHER}/{RESULT_NAME}", torn)
    assert storage.result("maps", OTHER) is None
    assert storage.results("maps", [DONE, OTHER]) == {DONE: {"says": "data"}}
    storage.sweep("maps")
    assert storage.finished("maps") == {DONE} and not any(OTHER in file for file in files_of(storage))


def test_sweeping_stays_out_of_a_kind_that_is_a_link(tmp_path: Path):
    storage, far = Storage(str(tmp_path / "out")), tmp_path / "far"
    storage.claim()
    put(Storage(str(far)), f"{DONE}/data.txt", f".new-{BEGUN}-0123abcd/data.txt")
    (tmp_path / "out" / "maps").symlink_to(far)
    storage.sweep("maps", {DONE})
    assert (far / DONE / "data.txt").exists() and (far / f".new-{BEGUN}-0123abcd" / "data.txt").exists()


def test_urls(tmp_path: Path):
    assert local_path(str(tmp_path)) == local_path(f"file://{tmp_path}") == tmp_path
    assert local_path("memory://drives") is None
    with pytest.raises(LanenetError, match=r"^nosuch://x: cannot be used as storage"):
        Storage("nosuch://x")
