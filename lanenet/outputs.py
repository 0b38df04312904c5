"""Outputs on disk: one run at a time writes each, and a complete folder replaces the old one in one step.

A run holds the lock of its output from before the work to the end: ``flock`` on the file ``.<name>.lock``
beside the output, which names the run. The kernel frees the lock of a process that has ended, however it
ended. Only the holder makes temporary files and folders of an output, so that whoever has the lock finds only
those of dead runs, and clears them.

Where the file system knows no ``flock`` (some network file systems), the lock lies in this machine's folder
for temporary files: runs on other machines are not kept out, and left-overs stay, since their owner may live.
"""

from __future__ import annotations

import ctypes
import errno
import hashlib
import os
import platform
import re
import secrets
import shutil
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from lanenet.errors import LanenetError

if sys.platform != "win32":
    import fcntl

#: Of ``renameat2``, see ``linux/fs.h`` and ``linux/fcntl.h``.
_RENAME_EXCHANGE, _AT_FDCWD = 2, -100
#: What a kernel, a file system or a sandbox answers that does not know a call.
_UNKNOWN_CALL = (errno.ENOSYS, errno.EINVAL, errno.EOPNOTSUPP, errno.ENOLCK, errno.EPERM)
#: So often the folder of an output is made again that is gone when its lock is. Chosen: other runs remove it
#: once each.
_TRIES = 100
#: Bytes of a lock that are read: what names its owner is shorter.
_LONGEST_OWNER = 400
#: Locks held by this process: process, thread and output. A forked child inherits the list, not the locks.
_held: set[tuple[int, int, Path]] = set()
#: Temporary files and folders that this process fills.
_unfinished: set[Path] = set()


@contextmanager
def lock_output(path: Path) -> Iterator[None]:
    """Keep other runs from writing an output while the block runs, and clear what dead runs left of it.

    The thread that has the lock may take it again. Missing parent folders are made, and go again if they stay
    empty.

    Args:
        path: File or folder to write; may be missing.

    Raises:
        LanenetError: If another run writes it, naming its process and machine; or if nothing can be written
            there.
    """
    path = Path(path).resolve()
    key = (os.getpid(), threading.get_ident(), path)
    if key in _held:
        yield
        return
    with ExitStack() as stack:
        try:
            shared = _lock(path, stack)
            _restore(path)
            if shared:
                for left in _left_overs(path):
                    remove(left)
        except OSError as error:
            raise LanenetError(f"{path}: cannot be written ({error})") from None
        _held.add(key)
        stack.callback(_held.discard, key)
        yield


def is_locked_here(path: Path) -> bool:
    """Tell whether this process has the lock of an output, in any thread."""
    return (os.getpid(), Path(path).resolve()) in {(process, held) for process, _, held in _held}


@contextmanager
def temporary_output(path: Path, ending: str = "") -> Iterator[Path]:
    """Yield a new name beside an output whose lock is held; what has that name afterwards is removed.

    Args:
        path: The output.
        ending: Of the name.

    Raises:
        LanenetError: For an OSError in the block that concerns the output; names it.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}-{secrets.token_hex(4)}.tmp{ending}")
    _unfinished.add(temporary)
    try:
        yield temporary
    except OSError as error:
        ours = (str(path), str(temporary).removesuffix(f".tmp{ending}"))
        if error.filename is None or str(error.filename).startswith(ours):
            raise LanenetError(f"{path}: cannot be written ({error})") from error
        raise
    finally:
        _unfinished.discard(temporary)
        remove(temporary)


def is_unfinished(path: Path) -> bool:
    """Tell whether a file is a temporary one of this process, or lies in such a folder."""
    return path in _unfinished or any(folder in _unfinished for folder in path.parents)


def put_in_place(temporary: Path, path: Path) -> None:
    """Give a complete folder its name; what had the name before is removed.

    One step where the file system can exchange two names. Elsewhere two, of which the second is done by the
    next run that writes or reads the output if this one is killed between them (:func:`restore_output`).

    Args:
        temporary: From :func:`temporary_output`.
        path: The output, whose lock is held.

    Raises:
        OSError: The old folder has its name then, unless only the sync of the new one failed.
    """
    old = temporary
    if not path.exists():
        temporary.rename(path)
    elif not exchange(temporary, path):
        new, old = _stage(temporary, "new"), _stage(temporary, "old")
        temporary.rename(new)
        try:
            path.rename(old)
            new.rename(path)
        except BaseException:
            if old.exists():
                old.rename(path)
            remove(new)
            raise
    sync_path(path.parent)
    remove(old)


def exchange(one: Path, other: Path) -> bool:
    """Exchange the names of two folders in one step; False if that cannot be done here.

    Raises:
        OSError: If it could be done here, and failed.
    """
    try:
        call = ctypes.CDLL(None, use_errno=True).renameat2
    except (AttributeError, OSError, TypeError):  # another system, or an old C library
        return False
    names = (os.fsencode(one), os.fsencode(other))
    if call(_AT_FDCWD, names[0], _AT_FDCWD, names[1], _RENAME_EXCHANGE) == 0:
        return True
    number = ctypes.get_errno()
    if number in _UNKNOWN_CALL:
        return False
    raise OSError(number, os.strerror(number), str(other))


def restore_output(path: Path) -> None:
    """Before a folder is read: if a run was killed between the two steps of an exchange, do the second.

    Nothing happens where the folder is there, or cannot be written.
    """
    path = Path(path).absolute()
    if path.exists() or not path.parent.is_dir():
        return
    with suppress(OSError, LanenetError):
        if any(_left_overs(path).values()):
            with lock_output(path):
                pass


def make_folder(path: Path) -> None:
    """Make a folder and those above it, where they are missing.

    Raises:
        LanenetError: If that is not possible.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        file = next((found for found in (path, *path.parents) if found.is_file()), None)
        reason = f" ({error})" if file is None else f", {file} is a file"
        raise LanenetError(f"{path}: the folder cannot be made{reason}") from None


def sync_path(path: Path) -> None:
    """Sync a file or folder to the disk, so that it survives a power cut."""
    if path.is_dir() and os.name == "nt":
        return
    descriptor = os.open(path, os.O_RDONLY if os.name != "nt" else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def remove(path: Path) -> None:
    """Remove a file, or a folder with all its contents; what cannot be removed stays for the next run."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink(missing_ok=True)


def _stage(temporary: Path, stage: str) -> Path:
    return temporary.with_name(f"{temporary.name.removesuffix('.tmp')}.{stage}.tmp")


def _left_overs(path: Path) -> dict[Path, str]:
    """Return the temporary names of an output, each with its stage of the exchange: new, old or none."""
    # Names without a process are those of earlier versions. A name that only starts alike belongs to another
    # output.
    pattern = re.compile(
        rf"\.{re.escape(path.name)}\.(?:\d+-)?[0-9a-f]{{8}}(?:\.(new|old))?\.tmp(?:\.[^.]*)?"
    )
    found = {left: pattern.fullmatch(left.name) for left in path.parent.iterdir()}
    return {left: match[1] or "" for left, match in found.items() if match is not None}


def _restore(path: Path) -> None:
    """Do the second step of an exchange whose owner is gone; the lock is held."""
    if path.exists():
        return
    # A new folder has that name only when it is complete.
    staged = {stage: left for left, stage in _left_overs(path).items() if stage}
    if staged:
        staged.get("new", staged.get("old", path)).rename(path)
        sync_path(path.parent)


def _lock(path: Path, stack: ExitStack) -> bool:
    """Take the lock until the stack ends; returns whether it keeps out other machines, too."""
    if sys.platform == "win32":
        _make_parents(path, stack)
        return False
    user_path = hashlib.sha256(f"{os.getuid()} {path}".encode()).hexdigest()[:16]
    fallback = Path(tempfile.gettempdir()) / f"lanenet-{user_path}.lock"
    shared, tries = True, 0
    while True:
        _make_parents(path, stack)
        lock = path.with_name(f".{path.name}.lock") if shared else fallback
        try:
            handle = os.open(lock, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o644)
        except FileNotFoundError:
            # Another run has just removed the empty folder; or nothing can be made in it, as in /proc.
            tries += 1
            if tries >= _TRIES:
                raise
            continue
        with ExitStack() as opened:
            opened.callback(os.close, handle)
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                owner = os.pread(handle, _LONGEST_OWNER, 0).decode(errors="replace").strip() or "another run"
                raise LanenetError(
                    f"{path}: is being written by {owner}; wait until that has ended, or choose another name"
                ) from None
            except OSError as error:
                if not shared or error.errno not in _UNKNOWN_CALL:
                    raise
                lock.unlink(missing_ok=True)
                shared = False
                continue
            if not re.fullmatch(rb"(process \d+ on .*\n)?", os.pread(handle, _LONGEST_OWNER, 0)):
                raise LanenetError(
                    f"{path}: cannot be locked, {lock} is not a lock of lanenet and stays as it is; choose "
                    "another name"
                )
            # The last owner removes the file: the lock counts if the file still has its name.
            with suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(handle), lock.stat()):
                    stack.push(opened.pop_all())
                    # Removed while it is still locked, so that nobody's file but this one goes.
                    stack.callback(remove, lock)
                    break
    # For people only: a full disk has no room for it.
    with suppress(OSError):
        os.ftruncate(handle, 0)
        os.write(handle, f"process {os.getpid()} on {platform.node()}\n".encode())
    return shared


def _make_parents(path: Path, stack: ExitStack) -> None:
    """Make the missing folders above an output; at the stack's end they go again if they are empty."""
    missing = [folder for folder in path.parents if not folder.exists()]
    make_folder(path.parent)
    for folder in reversed(missing):
        sync_path(folder.parent)
        stack.callback(_remove_empty, folder)


def _remove_empty(folder: Path) -> None:
    with suppress(OSError):
        folder.rmdir()
