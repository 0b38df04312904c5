from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
import sampled_checks
from hypothesis import settings

sampled_checks.install()

# Machines of a test farm are busy: a slow example is no failure, and a red run must be red again.
settings.register_profile("project", deadline=None, derandomize=True)
settings.load_profile("project")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--fail-on-skips",
        choices=("all", "any"),
        help="fail if all tests were skipped, or if any was: what tested nothing has not passed",
    )


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if "shared_data" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.data)


@pytest.hookimpl(tryfirst=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    """End as failed where too many tests were skipped; the summary then lists the reasons."""
    bound = session.config.getoption("--fail-on-skips")
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if bound is None or reporter is None or session.exitstatus != pytest.ExitCode.OK:
        return
    skipped, passed = (len(reporter.stats.get(outcome, ())) for outcome in ("skipped", "passed"))
    if skipped and (bound == "any" or not passed):
        session.exitstatus = pytest.ExitCode.TESTS_FAILED
        reporter.write_line(
            f"\nfailed: {skipped} tests were skipped and {passed} passed; the reasons stand below"
        )


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Real drives, which are not part of the repository; tests that need them are skipped without them."""
    named = os.environ.get("LANENET_SHARED_DATA")
    if not named or not Path(named).is_dir():
        pytest.skip(f"needs real drives: LANENET_SHARED_DATA has to name their folder, but it is {named!r}")
    return Path(named)


@pytest.fixture
def hang_up_ends() -> Iterator[None]:
    """A hang-up ends programs, as usual, even where the tests themselves were started to outlive one."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)
