from __future__ import annotations

import ast
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

REPO = Path(__file__).resolve().parents[2]
LINT_IMPORTS = Path(sys.executable).parent / "lint-imports"
#: Modules that start on the car, and the packages that the base installation does not have.
ONBOARD_MODULES = (
    *("lanenet.cli.app", "lanenet.evaluation.detect", "lanenet.perception.network.detector"),
    *("lanenet.onboard.drive", "lanenet.onboard.guard_process"),
)
HEAVY = (
    *("torch", "torchvision", "matplotlib", "scipy", "numba", "pyarrow"),
    *("onnx", "onnxscript", "safetensors", "tensorboard"),
)
#: What may be imported by its name in a text, which the import rules cannot see, and where: a Parquet file is
#: written, a bag read, a storage used, and a device of the car opened, only if its package is there.
NAMED_IMPORTS = {
    "datagen/fleet/ray_engine.py": {"ray"},
    "datagen/fleet/storage.py": {"fsspec"},
    "lanenet/data/": {"pyarrow"},
    "lanenet/data/hub.py": {"huggingface_hub"},
    "lanenet/data/drives/bag/": {"lz4", "mcap", "rosbags", "zstandard"},
    "lanenet/learn/sweep.py": {"optuna"},
    "lanenet/onboard/actuators/": {"serial", "termios"},
    "lanenet/onboard/cameras/": {"picamera2"},
    "lanenet/viewers/": {"rerun", "mcap"},
}
#: The one function that does it, and the one that opens compiled loops, which import nothing.
IMPORTERS = "lanenet/data/files.py", "lanenet/perception/edges/compiled.py"


def lint_imports(tree: Path) -> subprocess.CompletedProcess[str]:
    # The tree's own packages come first on the path, not those of the installation under test.
    environment = {**os.environ, "PYTHONPATH": str(tree), "COLUMNS": "200"}
    return subprocess.run(
        [str(LINT_IMPORTS), "--no-cache", "--no-logo"],
        cwd=tree,
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A copy of both packages and the import rules, free to be spoilt."""
    for package in ("lanenet", "datagen"):
        shutil.copytree(REPO / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(REPO / "pyproject.toml", tmp_path)
    return tmp_path


def test_the_import_rules_hold(tree: Path) -> None:
    result = lint_imports(tree)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "0 broken" in result.stdout


def test_wrong_way_imports_are_named(tree: Path) -> None:
    planted = [
        ("lanenet.geometry", "lanenet.data"),
        ("lanenet.onboard", "torch"),
        ("lanenet.perception", "scipy"),
        ("lanenet.onboard", "onnx"),
        ("lanenet.control", "tensorboard"),
        ("datagen", "lanenet.learn"),
        ("lanenet.learn", "datagen"),
        ("datagen", "torch"),
        ("datagen", "pyarrow"),
    ]
    for number, (room, imported) in enumerate(planted):
        # Inside a function, because a lazy import is an import all the same.
        late = f"def late() -> None:\n    import {imported}\n"
        tree.joinpath(*room.split("."), f"planted{number}.py").write_text(late)
    result = lint_imports(tree)
    assert result.returncode != 0, result.stdout
    for number, (room, imported) in enumerate(planted):
        assert f"{room}.planted{number} -> {imported}" in result.stdout


def loaded_packages(module: str) -> set[str]:
    """Import a module in a fresh interpreter and return the names of the packages that this loads."""
    code = f"import sys, {module}; print(*sorted({{name.partition('.')[0] for name in sys.modules}}))"
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False
    )
    assert result.returncode == 0, result.stderr
    return set(result.stdout.split())


@pytest.mark.parametrize("module", ONBOARD_MODULES)
def test_what_starts_on_the_car_loads_no_heavy_package(module: str) -> None:
    loaded = loaded_packages(module)
    assert "lanenet" in loaded
    assert loaded.isdisjoint(HEAVY), sorted(loaded.intersection(HEAVY))


def test_the_package_itself_loads_nothing() -> None:
    assert loaded_packages("lanenet").isdisjoint({*HEAVY, "numpy", "cv2", "typer", "pydantic", "datagen"})


def test_the_check_for_heavy_packages_can_fail() -> None:
    assert "torch" in loaded_packages("lanenet.learn.network")


def hidden_imports(source: str) -> list[str]:
    """Packages that a module imports by their names in a text; "?" where the name is not a plain text."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.Call):
            continue
        called = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        if called in ("require", "import_module", "__import__"):
            name = node.args[0] if node.args else None
            plain = isinstance(name, ast.Constant) and isinstance(name.value, str)
            found.append(name.value.partition(".")[0] if plain else "?")  # type: ignore[union-attr]
    return found


def test_no_import_goes_past_the_rules_by_its_name() -> None:
    seen = set()
    for path in sorted([*(REPO / "lanenet").rglob("*.py"), *(REPO / "datagen").rglob("*.py")]):
        name = path.relative_to(REPO).as_posix()
        found = set(hidden_imports(path.read_text(encoding="utf-8")))
        if name in IMPORTERS:
            assert found == {"?"}
            continue
        allowed = {p for place, packages in NAMED_IMPORTS.items() if name.startswith(place) for p in packages}
        assert found <= allowed, f"{name}: imports {found - allowed} past the import rules"
        seen |= found
    assert seen == {package for packages in NAMED_IMPORTS.values() for package in packages}


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ("def f():\n    return require('torch.nn', 'train')", ["torch"]),
        ("import importlib\nx = importlib.import_module('scipy')", ["scipy"]),
        ("files.require('onnx', 'train'); __import__('numba')", ["onnx", "numba"]),
        ("require(name, extra)", ["?"]),
        ("required('torch')", []),
    ],
)
def test_the_check_for_named_imports_can_fail(source: str, found: list[str]) -> None:
    assert sorted(hidden_imports(source)) == sorted(found)
