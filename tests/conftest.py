from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

# Machines of a test farm are busy: a slow example is no failure, and a red run must be red again.
settings.register_profile("project", deadline=None, derandomize=True)
settings.load_profile("project")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Real drives, which are not part of the repository; tests that need them are skipped without them."""
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("LANENET_SHARED_DATA", default))
    if not folder.is_dir():
        pytest.skip(f"no real data at {folder}; set LANENET_SHARED_DATA to where it is")
    return folder


@pytest.fixture
def hang_up_ends() -> Iterator[None]:
    """A hang-up ends programs, as usual, even where the tests themselves were started to outlive one."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)
