"""Outages of the car's bus, while whoever drives is killed, told to end, or left alone.

Run as a program, ``python outages.py [REPETITIONS]``, it prints a table and fails where a bound is broken.
"""

from __future__ import annotations

import math
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from bus_wire import BUS, Wire
from neutral_times import RATE_HZ, sender

from lanenet.errors import MotorMayRunError
from lanenet.onboard.actuators.pca9685 import PCA9685Settings, prescale_of
from lanenet.onboard.neutral import PATIENCE_S

#: What happens at the beginning of an outage, and the longest time to neutral after the later of two moments,
#: [s]: the end of the outage, and ``NORMAL_S`` after the fault.
FAULTS = {
    "drives on": 0.1,
    "loop killed": 0.1,
    "guard killed": 0.1,
    "guard stopped": 0.25,
    "Ctrl-C": 0.1,
    "SIGTERM": 0.1,
    "stop": 0.5,
}
#: When neutral is sent without an outage, after each fault; measured by ``make neutral`` (docs/driving.md).
NORMAL_S = {"guard stopped": 0.08}
SHORT_S = (0.02, 0.04, 0.08, 0.12, 0.3, 1.0)
LONG_S = (6.0, 30.0, math.inf)
MANNERS = ("fails", "hangs")
#: A line that says that the motor is in neutral.
_CLAIM = re.compile(r"(lanenet guard: )?neutral\b(?! (sent|not))")
#: The wire is watched this long after neutral, for a motor that starts again.
WATCHED_S = 0.4


@dataclass(frozen=True)
class Case:
    """One outage.

    Attributes:
        fault: One of ``FAULTS``.
        outage_s: Its length.
        manner: Whether transfers fail or hang.
        moment: When it begins between two commands, 0 to 1.
    """

    fault: str
    outage_s: float
    manner: str = "fails"
    moment: float = 0.5


@dataclass(frozen=True)
class Result:
    """What came of a case.

    Attributes:
        late_s: From the later moment to neutral on the wire; infinite if the motor still runs; NaN if the
            outage went by unnoticed, and the car drives on.
        code: Exit code of the drive, or of ``lanenet stop``; None if it drives on.
        said: What drive, guard and ``stop`` have said.
        wrong: What must not be; empty if all is well.
    """

    late_s: float
    code: int | None
    said: str
    wrong: str


def environment_of(folder: Path) -> dict[str, str]:
    """Return the environment of processes that find the emulated bus of a folder."""
    path = os.pathsep.join([str(BUS), os.environ.get("PYTHONPATH", "")])
    return {**os.environ, "LANENET_TEST_BUS": str(folder), "PYTHONPATH": path}


def run(case: Case, folder: Path) -> Result:
    """Drive into an outage, in a new folder."""
    folder.mkdir(parents=True)
    environment = environment_of(folder)
    wire, log = Wire(folder), folder / "log"
    car = folder / "car.yaml"
    car.write_text("actuator: {kind: pca9685}\n")
    process = sender('{"kind": "pca9685"}', log, environment)()
    guard = 0
    try:
        try:
            guard = wire.wait(driving=True, after_s=0.0).process
        except AssertionError as error:
            return Result(math.inf, None, log.read_text(errors="replace"), str(error))
        time.sleep(0.1 + case.moment / RATE_HZ)
        before = log.stat().st_size
        begin_s = time.monotonic()
        (folder / "outage.new").write_text(f"{begin_s + case.outage_s} {case.manner}")
        (folder / "outage.new").rename(folder / "outage")
        ended = _strike(case.fault, process, guard, car, environment, log)
        after_s = max(begin_s + case.outage_s, begin_s + NORMAL_S.get(case.fault, 0.0))
        patience_s = min(max(case.outage_s, 0.0), PATIENCE_S + 1.0) + 1.5
        end_s = begin_s + patience_s
        early = ""
        while time.monotonic() < end_s and (wire.motor()[-1][1] or time.monotonic() < after_s):
            if not early and time.monotonic() < begin_s + case.outage_s:
                early = _claim(log, before, wire, begin_s)
            time.sleep(0.01)
        if case.outage_s > PATIENCE_S:
            _wait_for(log, "disconnect the battery", 3.0)
        time.sleep(WATCHED_S)
        stopped_s, runs = wire.motor()[-1]
        drives_on = case.fault == "drives on" and process.poll() is None and runs
        last = ended if ended is not None else process
        code = None if drives_on else _code(last, 3.0)
        late_s = math.inf if runs else stopped_s - after_s
        claim = early or _claim(log, before, wire, begin_s, resumes=drives_on)
        return _judge(case, drives_on, late_s, code, log, claim)
    finally:
        for pid in (process.pid, guard):
            if pid:
                _kill(pid)
        process.wait()


def _strike(
    fault: str,
    process: subprocess.Popen[bytes],
    guard: int,
    car: Path,
    environment: dict[str, str],
    log: Path,
) -> subprocess.Popen[bytes] | None:
    """Let the fault happen; returns the process of ``lanenet stop``."""
    signals = {
        "loop killed": (process.pid, signal.SIGKILL),
        "guard killed": (guard, signal.SIGKILL),
        "guard stopped": (guard, signal.SIGSTOP),
        "Ctrl-C": (process.pid, signal.SIGINT),
        "SIGTERM": (process.pid, signal.SIGTERM),
    }
    if fault in signals:
        os.kill(*signals[fault])
    if fault != "stop":
        return None
    words = [sys.executable, "-m", "lanenet", "stop", str(car)]
    with log.open("ab") as stream:
        return subprocess.Popen(words, env=environment, stdout=stream, stderr=stream)


def _claim(log: Path, before: int, wire: Wire, since_s: float, resumes: bool = False) -> str:
    """Return the line that says neutral, without an addition, while the motor runs; empty if none does.

    A car that drives on may have been in neutral meanwhile.
    """
    said = log.read_bytes()[before:].decode(errors="replace")
    lines = [line for line in said.splitlines() if _CLAIM.match(line)]
    runs = (wire.motor()[-1][1] and not resumes) or not [
        w for w in wire.throttles(driving=False) if w.t_s >= since_s
    ]
    return lines[0] if lines and runs else ""


def _judge(case: Case, drives_on: bool, late_s: float, code: int | None, log: Path, claim: str) -> Result:
    said = log.read_text(errors="replace")
    wrong = [f"it says {claim!r}"] if claim else []
    if drives_on:
        # A command that hangs for a moment is no fault: the guard counts it as one after 0.25 s.
        if case.outage_s > (2.0 / RATE_HZ if case.manner == "fails" else 0.25):
            wrong.append("the outage was not noticed")
        return Result(math.nan, None, said, "; ".join(wrong))
    confirmed = case.outage_s < PATIENCE_S
    if confirmed:
        if late_s > FAULTS[case.fault]:
            wrong.append(f"neutral {late_s:.3f} s after the later moment")
        if code == MotorMayRunError.exit_code:
            wrong.append("the code of a motor that may run")
        if case.fault in ("Ctrl-C", "SIGTERM", "stop") and code != 0:
            wrong.append(f"code {code} after an end on purpose")
    else:
        if "disconnect the battery" not in said:
            wrong.append("nobody said to disconnect the battery")
        if case.fault != "loop killed" and code != MotorMayRunError.exit_code:
            wrong.append(f"code {code}, expected {MotorMayRunError.exit_code}")
    return Result(late_s, code, said, "; ".join(wrong))


def _wait_for(log: Path, text: str, timeout_s: float) -> None:
    end_s = time.monotonic() + timeout_s
    while text not in log.read_text(errors="replace") and time.monotonic() < end_s:
        time.sleep(0.05)


def _code(process: subprocess.Popen[bytes], timeout_s: float) -> int | None:
    try:
        return process.wait(timeout_s)
    except subprocess.TimeoutExpired:
        return None


def _kill(pid: int) -> None:
    try:
        os.kill(pid, signal.SIGKILL)
    except ProcessLookupError:
        return


def all_cases(repetitions: int) -> list[Case]:
    """Every fault with every outage; short ones several times, long ones once."""
    short = [
        Case(fault, outage_s, MANNERS[number % 2] if outage_s >= 0.12 else "fails", number / repetitions)
        for fault in FAULTS
        for outage_s in SHORT_S
        for number in range(repetitions)
    ]
    return (
        short
        + [Case(fault, outage_s, "fails") for fault in FAULTS for outage_s in LONG_S]
        + [Case(fault, outage_s, "hangs") for fault in FAULTS for outage_s in LONG_S]
    )


def run_all(cases: Iterable[Case], folder: Path) -> dict[Case, Result]:
    """Run cases: short ones by twos, long ones, which wait, eight at a time."""
    numbered = list(enumerate(cases))
    results: dict[Case, Result] = {}
    for workers, chosen in ((2, lambda c: c.outage_s < 6.0), (8, lambda c: c.outage_s >= 6.0)):
        with ThreadPoolExecutor(workers) as pool:
            jobs = {case: pool.submit(run, case, folder / str(n)) for n, case in numbered if chosen(case)}
        results |= {case: job.result() for case, job in jobs.items()}
    return results


def table(results: dict[Case, Result]) -> list[str]:
    """Rows by fault and outage: repetitions, median and worst lateness, and what was wrong."""
    lines = [f"{'fault':14} {'outage':>8} {'runs':>5} {'median':>8} {'worst':>8}  after the later moment, ms"]
    for fault in FAULTS:
        for outage_s in (*SHORT_S, *LONG_S):
            found = [r for c, r in results.items() if (c.fault, c.outage_s) == (fault, outage_s)]
            if not found:
                continue
            late_ms = sorted(1e3 * r.late_s for r in found if math.isfinite(r.late_s))
            name = "for ever" if math.isinf(outage_s) else f"{outage_s:g} s"
            times = (
                f"{late_ms[len(late_ms) // 2]:8.0f} {late_ms[-1]:8.0f}" if late_ms else f"{'-':>8} {'-':>8}"
            )
            if outage_s > PATIENCE_S:
                times = f"{'':8} {'':8}  message, code {', '.join(sorted({str(r.code) for r in found}))}"
            on = sum(math.isnan(r.late_s) for r in found)
            note = f"  {on} not noticed, drives on" if on else ""
            wrong = {r.wrong for r in found if r.wrong}
            note += f"  WRONG: {'; '.join(sorted(wrong))}" if wrong else ""
            lines.append(f"{fault:14} {name:>8} {len(found):5} {times}{note}")
    return lines


def rate_changes() -> list[tuple[float, float]]:
    """Let another program change the chip's rate; returns (rate, seconds until neutral at the right rate)."""
    found = []
    for rate_hz in (40.0, 50.0, 100.0):
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name:
            found.append((rate_hz, _change_rate(rate_hz, Path(name) / "bus")))
    return found


def _change_rate(rate_hz: float, folder: Path) -> float:
    folder.mkdir()
    environment = environment_of(folder)
    wire = Wire(folder)
    process = sender('{"kind": "pca9685"}', folder / "log", environment)()
    try:
        wire.wait(driving=True, after_s=0.0)
        time.sleep(0.2)
        with (folder / "registers").open("r+b", buffering=0) as chip:
            changed_s = time.monotonic()
            os.pwrite(chip.fileno(), bytes([prescale_of(rate_hz)]), 0xFE)
        right = prescale_of(PCA9685Settings().frequency_hz)
        end_s = changed_s + 2.0
        while time.monotonic() < end_s:
            again = [w.t_s for w in wire.writes() if w.register == 0xFE and w.t_s > changed_s]
            done = [w.t_s for w in wire.throttles(driving=False) if again and w.t_s > again[-1]]
            if done and (folder / "registers").read_bytes()[0xFE] == right:
                return done[0] - changed_s
            time.sleep(0.005)
        return math.inf
    finally:
        process.kill()
        process.wait()


def stop_under_load(count: int, load: int = 8) -> list[float]:
    """Stop a car beside busy processes; returns seconds from the command to neutral on the wire."""
    busy = [subprocess.Popen([sys.executable, "-ISc", "while True: pass"]) for _ in range(load)]
    try:
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name:
            return [_stop(Path(name) / str(number), number / count) for number in range(count)]
    finally:
        for process in busy:
            process.kill()
            process.wait()


def _stop(folder: Path, moment: float) -> float:
    folder.mkdir()
    environment = environment_of(folder)
    car = folder / "car.yaml"
    car.write_text("actuator: {kind: pca9685}\n")
    wire = Wire(folder)
    process = sender('{"kind": "pca9685"}', folder / "log", environment)()
    try:
        wire.wait(driving=True, after_s=0.0)
        time.sleep(0.3 + moment / RATE_HZ)
        begun_s = time.monotonic()
        words = [sys.executable, "-m", "lanenet", "stop", str(car)]
        subprocess.run(words, env=environment, check=True, stdout=subprocess.DEVNULL, timeout=60.0)
        stopped_s, runs = wire.motor()[-1]
        return math.inf if runs else stopped_s - begun_s
    finally:
        process.kill()
        process.wait()


def main(words: list[str]) -> int:
    repetitions = int(words[0]) if words else 5
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name:
        results = run_all(all_cases(repetitions), Path(name))
    rates = rate_changes()
    stops_s = sorted(stop_under_load(20))
    late = [f"{rate:g} Hz" for rate, passed_s in rates if passed_s > 0.1]
    print("\n".join(table(results)))  # noqa: T201 (the figures of the documentation)
    print(  # noqa: T201
        "rate changed to "
        + ", ".join(f"{rate:g} Hz: neutral after {1e3 * passed_s:.0f} ms" for rate, passed_s in rates)
    )
    print(  # noqa: T201
        f"stop at a load of 8: neutral after {1e3 * stops_s[10]:.0f} ms (median), {1e3 * stops_s[-2]:.0f} ms "
        f"(19 of 20), {1e3 * stops_s[-1]:.0f} ms (worst)"
    )
    return (
        1 if late or stops_s[-2] > FAULTS["stop"] or any(result.wrong for result in results.values()) else 0
    )


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
