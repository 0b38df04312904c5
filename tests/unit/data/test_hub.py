"""The Hub, played by a folder whose functions take what those of huggingface_hub take."""

from __future__ import annotations

import inspect
import shutil
from pathlib import Path
from typing import Any

import huggingface_hub
import numpy as np
import pytest
import yaml
from synthetic_labels import make_label_set
from typer.testing import CliRunner, Result

import lanenet
from lanenet.cli.app import app
from lanenet.data.camera_file import read_camera
from lanenet.data.hub import pulled, push
from lanenet.data.label_set import write_labels
from lanenet.errors import ConfigError, LanenetError

CHECKPOINT = Path(__file__).resolve().parents[3] / "checkpoints" / "small"
REAL = huggingface_hub.HfApi


class FolderHub:
    """Repositories as folders of a folder."""

    root: Path
    private: dict[str, bool]

    def _place(self, repo_id: str, repo_type: str) -> Path:
        return self.root / repo_type / repo_id

    def create_repo(self, **given: Any) -> str:
        inspect.signature(REAL.create_repo).bind(self, **given)
        self._place(given["repo_id"], given["repo_type"]).mkdir(parents=True, exist_ok=given["exist_ok"])
        self.private[given["repo_id"]] = given["private"]
        return f"https://huggingface.co/{given['repo_id']}"

    def create_commit(self, **given: Any) -> None:
        inspect.signature(REAL.create_commit).bind(self, **given)
        for operation in given["operations"]:
            path = self._place(given["repo_id"], given["repo_type"]) / operation.path_in_repo
            path.parent.mkdir(parents=True, exist_ok=True)
            with operation.as_file() as stream:
                path.write_bytes(stream.read())

    def snapshot_download(self, **given: Any) -> str:
        inspect.signature(REAL.snapshot_download).bind(self, **given)
        place = self._place(given["repo_id"], given["repo_type"])
        if not place.is_dir():
            raise FileNotFoundError("404: Repository Not Found")
        copy = self.root / "cache" / given["repo_id"]
        shutil.rmtree(copy, ignore_errors=True)
        copy.mkdir(parents=True)
        for pattern in given["allow_patterns"]:
            for path in place.glob(pattern):
                shutil.copy(path, copy)
        return str(copy)


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FolderHub:
    FolderHub.root, FolderHub.private = tmp_path / "hub", {}
    monkeypatch.setattr(huggingface_hub, "HfApi", FolderHub)
    return FolderHub()


def run(*words: object) -> Result:
    return CliRunner().invoke(app, [str(word) for word in words], env={"COLUMNS": "200"})


def test_a_model_goes_to_the_hub_and_comes_back_by_its_name(hub: FolderHub, tmp_path: Path) -> None:
    folder = tmp_path / "small"
    shutil.copytree(CHECKPOINT, folder)
    assert push(folder, "me/small", "model", {"library_name": "lanenet"}) == "https://huggingface.co/me/small"
    assert hub.private == {"me/small": True}
    _, head, text = (hub.root / "model/me/small/README.md").read_text().split("---\n", 2)
    assert yaml.safe_load(head) == {"library_name": "lanenet"}
    assert text.strip() == (folder / "MODEL_CARD.md").read_text().strip()
    camera = read_camera(folder / "camera.yaml")
    image = np.full((camera.height, camera.width, 3), 90, np.uint8)
    np.testing.assert_array_equal(
        lanenet.load("hf:me/small")(image).points_cm, lanenet.load(folder)(image).points_cm
    )


def test_the_command_pushes_and_val_pulls_a_label_set(hub: FolderHub, tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    write_labels(tmp_path / "data" / "labels.parquet", make_label_set(3, 0))
    push(tmp_path / "data", "me/lanes", "dataset", public=True)
    assert hub.private == {"me/lanes": False}
    assert pulled("hf:datasets/me/lanes").read_bytes() == (tmp_path / "data" / "labels.parquet").read_bytes()
    result = run("val", "hf:datasets/me/lanes", "--detectors", "lane-filter")
    assert result.exit_code == 0, result.output
    assert "labels.parquet" in result.output


def test_export_pushes_a_checkpoint(hub: FolderHub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(CHECKPOINT, tmp_path / "small")
    result = run("export", tmp_path / "small", "--push", "me/small")
    assert result.exit_code == 0, result.output
    assert "on the Hub: https://huggingface.co/me/small" in result.output
    assert "next: lanenet detect my_tub --model hf:me/small" in result.output
    assert (hub.root / "model/me/small/model.onnx").read_bytes() == (
        tmp_path / "small/model.onnx"
    ).read_bytes()


@pytest.mark.parametrize(
    ("name", "error", "words"),
    [
        ("hf:me", ConfigError, "'me': expected a name on the Hugging Face Hub, as in owner/name"),
        ("hf:me/../x", ConfigError, "expected a name"),
        ("hf:me/nothing", LanenetError, "me/nothing: the Hugging Face Hub answers: 404.*hf auth login"),
        ("hf:me/empty", LanenetError, r"hf:me/empty: holds no model\.onnx"),
    ],
)
def test_what_is_not_on_the_hub_is_said(
    hub: FolderHub, name: str, error: type[LanenetError], words: str
) -> None:
    (hub.root / "model/me/empty").mkdir(parents=True)
    with pytest.raises(error, match=words):
        pulled(name)


def test_a_path_stays_a_path() -> None:
    assert pulled("runs/hf") == Path("runs/hf")
    assert pulled(CHECKPOINT) == CHECKPOINT


def test_only_what_the_hub_takes_is_pushed(hub: FolderHub, tmp_path: Path) -> None:
    labels = tmp_path / "a.parquet"
    words = ("export", labels, "--format", "coco", "--push", "me/x")
    assert "--push: expected --format huggingface, found coco" in run(*words).output
    assert "--push: puts a checkpoint folder" in run("export", CHECKPOINT, "--int8", "--push", "me/x").output
    assert not hub.private
