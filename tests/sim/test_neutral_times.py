"""Neutral on the wire, whatever is killed or stopped, twenty times each; `make neutral` prints the times."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from board_process import BoardProcess, build_host_board, build_uno
from bus_wire import BUS, MONOSTABLE_S, SETTINGS, Wire
from neutral_times import ALLOWED_S, FAULTS, seconds_to_neutral, sender, table

from lanenet.onboard.actuators.pca9685 import PCA9685Settings

STOPPED_US = 1500.0
COUNT = 20
#: The system may wake a process late, and a busy test machine does.
LATE_S = 0.15


@pytest.fixture(scope="module")
def board(tmp_path_factory: pytest.TempPathFactory) -> Iterator[BoardProcess]:
    """The board's protocol and watchdog, compiled for this computer."""
    folder = tmp_path_factory.mktemp("board")
    board = BoardProcess([build_host_board(folder)], folder)
    yield board
    board.stop()


@pytest.fixture(scope="module")
def uno(tmp_path_factory: pytest.TempPathFactory) -> Iterator[BoardProcess]:
    """The sketch on a simulated Uno: a pulse begins every 20 ms."""
    folder = tmp_path_factory.mktemp("uno")
    board = BoardProcess(build_uno(folder), folder)
    yield board
    board.stop()


def check_times(fault: str, board: BoardProcess, log: Path) -> None:
    pytest.importorskip("serial", reason="pyserial is not installed")
    settings = json.dumps({"kind": "serial", "port": board.port, "throttle_stopped_us": STOPPED_US})
    start = sender(settings, log)
    times_s = [
        seconds_to_neutral(fault, start, lambda: board.motor(STOPPED_US), number / COUNT)
        for number in range(COUNT)
    ]
    print(table({fault: times_s}))  # noqa: T201 (the figures of the documentation)
    assert sorted(times_s)[COUNT // 2] <= ALLOWED_S
    assert max(times_s) <= ALLOWED_S + LATE_S


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS)
def test_neutral_by_the_protocol(fault: str, board: BoardProcess, tmp_path: Path) -> None:
    check_times(fault, board, tmp_path / "log")


@pytest.mark.slow
def test_neutral_on_the_pins_of_an_uno(uno: BoardProcess, tmp_path: Path) -> None:
    check_times("both killed", uno, tmp_path / "log")


@pytest.fixture
def strike_pca9685(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., float]:
    """Strikes a car with a PCA9685, whose OE pin hangs on a watchdog of hardware if the settings say so."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(BUS), os.environ.get("PYTHONPATH", "")]))

    def strike(fault: str, moment: float, settings: PCA9685Settings = SETTINGS) -> float:
        folder = tmp_path / str(moment)
        folder.mkdir()
        monkeypatch.setenv("LANENET_TEST_BUS", str(folder))
        start = sender(settings.model_dump_json(exclude_unset=True), tmp_path / "log")
        return seconds_to_neutral(fault, start, Wire(folder).motor, moment)

    return strike


def test_a_stopped_guard_does_not_drive_on(strike_pca9685: Callable[..., float]) -> None:
    # Without the watchdog at OE, which would be in time as well. The loop kills a guard only after 0.25 s.
    assert strike_pca9685("guard stopped", 0.5, PCA9685Settings(kind="pca9685")) <= ALLOWED_S + LATE_S


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS)
def test_neutral_of_a_pca9685(fault: str, strike_pca9685: Callable[..., float]) -> None:
    times_s = [strike_pca9685(fault, number / COUNT) for number in range(COUNT)]
    print(table({fault: times_s}))  # noqa: T201 (the figures of the documentation)
    # With nobody left it is the monostable, whose last pulse came with the last command.
    allowed_s = MONOSTABLE_S if "both" in fault else ALLOWED_S
    assert sorted(times_s)[COUNT // 2] <= allowed_s
    assert max(times_s) <= allowed_s + LATE_S
