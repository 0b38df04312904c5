"""A lock that is waited for only briefly: a command that hangs must not keep the motor running."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

_LONGEST_WAIT_S = 0.02


@contextmanager
def brief_lock(lock: threading.Lock) -> Iterator[None]:
    """Hold a lock if it can be had at once or nearly so; go on without it if not.

    Args:
        lock: Held by commands while they are sent.
    """
    locked = lock.acquire(timeout=_LONGEST_WAIT_S)
    try:
        yield
    finally:
        if locked:
            lock.release()
