"""Asks for every address that the documents name, and fails if one does not answer: ``make links``."""

from __future__ import annotations

import re
import sys
import urllib.error
import urllib.request
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

#: Chosen: slow hosts answer within some seconds.
_TIMEOUT_S = 20.0
#: Answers of hosts that want a browser, or a person: the page is there.
_THERE = (401, 403, 405, 429)


def main() -> int:
    """Print what does not answer; the exit code is 1 if anything did not."""
    addresses: dict[str, Path] = {}
    for document in [*Path().glob("*.md"), *Path("docs").rglob("*.md"), *Path("checkpoints").rglob("*.md")]:
        for address in re.findall(r"https?://[^\s)>\"'`]+", document.read_text(encoding="utf-8")):
            addresses.setdefault(address.rstrip(".,;"), document)
    with ThreadPoolExecutor(8) as pool:
        answers = dict(zip(addresses, pool.map(problem_of, addresses), strict=True))
    broken = [
        f"{addresses[address]}: {address}: {problem}" for address, problem in answers.items() if problem
    ]
    sys.stdout.write(
        "".join(f"{line}\n" for line in [*broken, f"{len(addresses)} addresses, {len(broken)} broken"])
    )
    return 1 if broken else 0


def problem_of(address: str) -> str:
    """Why an address does not answer; empty if it does."""
    request = urllib.request.Request(address, headers={"User-Agent": "Mozilla/5.0 (link check)"})
    try:
        with urllib.request.urlopen(request, timeout=_TIMEOUT_S):
            return ""
    except urllib.error.HTTPError as error:
        return "" if error.code in _THERE else str(error)
    except (OSError, ValueError) as error:
        return str(error)


if __name__ == "__main__":
    raise SystemExit(main())
