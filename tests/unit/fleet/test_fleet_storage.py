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


def test_sweeping_removes_what_was_begun_and_keeps_what_is_finished(storage: Storage):
    fill(storage, "done")
    fill(storage, "other")
    system, root = fsspec.core.url_to_fs(storage.url)
    # As a killed worker leaves it: under a temporary name, or without a marker; and a lock.
    for path in ("maps/.new-b-12/result.json", "maps/c/labels.parquet", "maps/..new-b-12.lock"):
        system.makedirs(f"{root}/{path}".rpartition("/")[0], exist_ok=True)
        system.pipe_file(f"{root}/{path}", b"{}")
    assert storage.finished("maps") == {"done", "other"}
    storage.sweep("maps")
    assert {file.split("/")[2] for file in files_of(storage)} == {"done", "other"}
    storage.sweep("maps", {"other", "never there"})
    assert storage.finished("maps") == {"done"}
    storage.sweep("labels")


def test_files_beside_the_results(storage: Storage):
    storage.write("drives.json", b"one")
    storage.write("drives.json", b"two")
    assert storage.read("drives.json") == b"two" and storage.finished("maps") == set()


def test_a_damaged_marker_names_the_storage(storage: Storage):
    fill(storage, "a")
    system, root = fsspec.core.url_to_fs(storage.url)
    system.pipe_file(f"{root}/maps/a/{RESULT_NAME}", b"{")
    with pytest.raises(LanenetError, match=storage.url.rpartition("/")[2]):
        storage.result("maps", "a")


def test_urls(tmp_path: Path):
    assert local_path(str(tmp_path)) == local_path(f"file://{tmp_path}") == tmp_path
    assert local_path("memory://drives") is None
    with pytest.raises(LanenetError, match=r"^nosuch://x: cannot be used as storage"):
        Storage("nosuch://x")
