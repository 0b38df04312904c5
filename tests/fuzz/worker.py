"""Runs fuzz cases in a process with limits; writes a line of JSON before and after each one.

python tests/fuzz/worker.py FOLDER SEED FIRST COUNT        (cases by number)
python tests/fuzz/worker.py FOLDER --corpus                (every file of tests/fuzz/corpus)
"""

from __future__ import annotations

import gc
import json
import os
import resource
import shutil
import sys
import time
import traceback
import warnings
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
sys.path[:0] = [str(ROOT / "tests" / "support"), str(HERE)]

import cv2  # noqa: E402
import numpy as np  # noqa: E402
import torch  # noqa: E402
from fuzz_readers import READERS  # noqa: E402
from mutations import mutate  # noqa: E402

from lanenet.errors import LanenetError  # noqa: E402

CORPUS = HERE / "corpus"
#: Beyond what the process takes before the first case.
MEMORY = 2**30
#: Where the interpreter and the packages lie, and what a system tells about itself.
OWN = tuple(str(p) for p in (sys.prefix, sys.base_prefix, ROOT, "/proc", "/sys", "/usr/lib", "/usr/share"))

#: Of the case at hand: its folder, and what was opened outside of it; None between cases.
_folder: Path | None = None
_outside: list[str] = []


def watch(event: str, args: tuple[Any, ...]) -> None:
    """Note files that are opened, written, moved or removed outside of a case's folder."""
    if _folder is None or event not in ("open", "os.remove", "os.rename", "os.mkdir", "os.symlink"):
        return
    if not isinstance(args[0], str | bytes | os.PathLike):
        return
    path = os.path.realpath(os.fsdecode(args[0]))
    writes = event != "open" or bool((args[2] or 0) & (os.O_WRONLY | os.O_RDWR | os.O_CREAT))
    if path.startswith(str(_folder)) or (path.startswith(OWN) and not writes) or path == os.devnull:
        return
    _outside.append(path)


def run(name: str, folder: Path) -> dict[str, Any]:
    """Read the files of a case; returns what happened and what it took."""
    global _folder
    Path("/proc/self/clear_refs").write_text("5")
    before, begin = peak_bytes(), time.monotonic()
    _outside.clear()
    _folder = folder.resolve()
    why = ""
    try:
        READERS[name].read(folder)
        found = "read"
    except LanenetError as error:
        found, cause = "refused", error.__cause__ or error.__context__
        # Python's own parser says so of what is nested too deeply.
        if isinstance(cause, MemoryError) and name != "myconfig":
            found, why = "memory", str(error)
    except BaseException as error:
        found, why = "traceback", "".join(traceback.format_exception(error)[-6:])
    finally:
        _folder = None
    if _outside and not READERS[name].anywhere:
        found, why = "outside", ", ".join(_outside)
    took = peak_bytes() - before
    if took > MEMORY:
        found, why = "memory", f"{took / 2**20:.0f} MB"
    return {"found": found, "why": why[-1500:], "s": time.monotonic() - begin, "bytes": took}


def peak_bytes() -> int:
    """Largest memory of the process so far."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * int(next(line.split()[1] for line in lines if line.startswith("VmHWM")))


def case(work: Path, name: str) -> Path:
    """Return a fresh copy of a reader's files, in a folder beside canaries."""
    shutil.rmtree(work / "case", ignore_errors=True)
    shutil.copytree(work / "templates" / name, work / "case", symlinks=True)
    return work / "case"


def say(**what: Any) -> None:
    print(json.dumps(what), flush=True)  # noqa: T201 (what the process says)


def main(work: Path, words: list[str]) -> None:
    """Run the cases."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    warnings.simplefilter("ignore")
    names = sorted(READERS)
    for name in names:
        template = work / "templates" / name
        if not template.is_dir():
            shutil.rmtree(work / "making", ignore_errors=True)
            (work / "making").mkdir(parents=True)
            READERS[name].make(work / "making")
            (work / "templates").mkdir(exist_ok=True)
            (work / "making").rename(template)
        # The first time loads libraries; and what is not damaged is read.
        READERS[name].read(case(work, name))
    (work / "canary.txt").write_text("frame,t_s\n0,0\n")
    shutil.copy(work / "templates" / "photo" / "a.jpg", work / "canary.jpg")
    if not (work / "pipe").exists():
        os.mkfifo(work / "pipe")
    gc.collect()
    gc.freeze()
    listed = sorted(p.name for p in work.iterdir())
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + MEMORY + 2**28
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    sys.addaudithook(watch)
    if words == ["--corpus"]:
        for kept in sorted(p for p in CORPUS.rglob("*") if p.is_file()):
            name, file = kept.parent.relative_to(CORPUS).parts[0], kept.name.partition("--")[2]
            folder = case(work, name)
            shutil.copy(kept, folder / file.replace("+", "/"))
            say(begin=str(kept.relative_to(CORPUS)))
            say(case=str(kept.relative_to(CORPUS)), reader=name, **run(name, folder))
        return
    seed, first, count = (int(word) for word in words)
    for number in range(first, first + count):
        name = names[number % len(names)]
        folder = case(work, name)
        path = mutate(folder, np.random.default_rng([seed, number]))
        file = "+".join(path.relative_to(folder).parts)
        say(begin=number, reader=name, file=file)
        what = run(name, folder)
        if sorted(p.name for p in work.iterdir()) != listed:
            what |= {"found": "outside", "why": f"in {work}: {sorted(p.name for p in work.iterdir())}"}
        say(case=number, reader=name, file=file, **what)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
