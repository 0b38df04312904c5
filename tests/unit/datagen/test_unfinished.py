"""Left-overs of killed runs."""

from __future__ import annotations

from pathlib import Path

import pytest

from lanenet.data.files import atomic_folder, clear_unfinished


def _folder(path: Path) -> Path:
    path.mkdir(parents=True)
    (path / "map.yaml").write_text("format: lanenet-map/1\n")
    return path


def test_left_overs_go_and_neighbours_stay(tmp_path):
    out = _folder(tmp_path / "one")
    gone = [_folder(tmp_path / name) for name in (".one.0123abcd.tmp", ".one.ffffffff.old.tmp")]
    stay = [
        _folder(tmp_path / name)
        for name in (".one.b.0123abcd.tmp", ".two.0123abcd.tmp", ".one.tmp", ".one.backup99.tmp")
    ]
    clear_unfinished(out)
    assert not any(path.exists() for path in gone)
    assert all((path / "map.yaml").is_file() for path in (out, *stay))


def test_an_old_folder_comes_back_when_the_new_one_never_came(tmp_path):
    _folder(tmp_path / ".one.0123abcd.old.tmp")
    clear_unfinished(tmp_path / "one")
    assert [path.name for path in tmp_path.iterdir()] == ["one"]
    clear_unfinished(tmp_path / "nowhere" / "one")


def test_the_names_are_those_of_atomic_folder(tmp_path, monkeypatch):
    monkeypatch.setattr("shutil.rmtree", lambda *_, **__: None)
    with pytest.raises(KeyboardInterrupt), atomic_folder(tmp_path / "one", "map") as temporary:
        raise KeyboardInterrupt
    assert temporary.is_dir()
    monkeypatch.undo()
    clear_unfinished(tmp_path / "one")
    assert not list(tmp_path.iterdir())
