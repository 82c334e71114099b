"""Who a folder belongs to: one process at a time writes into it, and always for the same axis.

The lock ends with its process, however that ends. The name stays: recordings and checkpoints of two axes in one folder
could not be told apart, and a start would learn again what another axis has recorded.
"""

from __future__ import annotations

import contextlib
import errno
import importlib
import os
import time
from pathlib import Path
from typing import Final

from dehyst.service.protocol.errors import FieldError

#: Pause between two tries to hold a folder, s.
_PAUSE_S: Final = 0.05
#: Longest name that is read back, bytes.
_MOST_BYTES: Final = 4096
#: Offset of the byte that Windows locks: what is locked there cannot be read, so it must be behind the name.
_BEHIND: Final = 2**30


class FolderOwnedError(BlockingIOError):
    """Another process holds the folder, or it belongs to another axis."""


class FolderOwner:
    """Holds ``directory`` for this process and for ``owner``, by the file ``name`` in it.

    Parameters
    ----------
    owner : stage and axis, as ``demo/x``; "": any, for what no service continues.
    """

    def __init__(self, directory: Path, name: str, owner: str = "") -> None:
        self.directory = directory
        self._path = directory / name
        self._owner = owner
        self._file: int | None = None

    def take(self) -> None:
        """Hold the folder, which is made where it is missing; take it anew where it was removed.

        Raises FolderOwnedError, which names the folder and its owner; OSError as the disk does.
        """
        if self._file is not None and is_still_at(self._file, self._path):
            return
        self.release()
        self.directory.mkdir(parents=True, exist_ok=True)
        file = os.open(self._path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            self._lock(file)
            self._leave_name(file)
        except BaseException:
            os.close(file)
            raise
        self._file = file

    def hold(self, field: str, timeout_s: float) -> None:
        """`take`, waiting ``timeout_s`` for a process that ends.

        Raises FieldError for the setting ``field`` where the folder stays another's. Where the disk does not allow a
        lock, writing fails later, and is counted.
        """
        until = time.monotonic() + timeout_s
        while True:
            try:
                return self.take()
            except FolderOwnedError as error:
                if time.monotonic() < until:
                    time.sleep(_PAUSE_S)
                    continue
                raise FieldError(
                    field,
                    error.strerror,
                    "a folder that no other process and no other axis writes into",
                    "end the other service, or give each axis a folder of its own",
                ) from error
            except OSError:
                return

    def release(self) -> None:
        """Leave the folder to others; never raises."""
        if self._file is not None:
            with contextlib.suppress(OSError):
                os.close(self._file)
            self._file = None

    def _lock(self, file: int) -> None:
        try:
            _lock_now(file)
        except (BlockingIOError, PermissionError) as error:
            holder = ", ".join(filter(None, _words(file))) or "another process"
            raise FolderOwnedError(error.errno, f"{self.directory}, held by {holder}") from error

    def _leave_name(self, file: int) -> None:
        owner = _words(file)[0]
        if self._owner and owner not in ("", self._owner):
            raise FolderOwnedError(errno.EWOULDBLOCK, f"{self.directory}, which holds files of {owner}")
        words = f"{self._owner or owner}\nprocess {os.getpid()}\n".encode()
        # In place: a full disk takes that too. Without the name the lock holds as well.
        with contextlib.suppress(OSError):
            os.lseek(file, 0, os.SEEK_SET)
            os.write(file, words)
            os.ftruncate(file, len(words))


def owner_of(directory: Path, name: str) -> str:
    """Whom the folder belongs to, as the file ``name`` in it says; "" where it does not say."""
    try:
        file = os.open(directory / name, os.O_RDONLY)
    except OSError:
        return ""
    try:
        return _words(file)[0]
    finally:
        os.close(file)


def is_still_at(descriptor: int, path: Path) -> bool:
    """Whether the open file is still the one at ``path``: neither removed nor renamed, nor its folder."""
    try:
        there = path.stat()
    except OSError:
        return False
    here = os.fstat(descriptor)
    return (here.st_dev, here.st_ino) == (there.st_dev, there.st_ino)


def _words(file: int) -> tuple[str, str]:
    """(owner, process) as the file says, "" for what it does not say."""
    try:
        os.lseek(file, 0, os.SEEK_SET)
        lines = os.read(file, _MOST_BYTES).decode(errors="replace").split("\n")
    except OSError:
        return "", ""
    return lines[0], lines[1] if len(lines) > 1 else ""


def _lock_now(descriptor: int) -> None:
    """Lock an open file until it is closed. Raises OSError where another process holds it."""
    try:
        import fcntl
    except ImportError:  # Windows
        msvcrt = importlib.import_module("msvcrt")
        os.lseek(descriptor, _BEHIND, os.SEEK_SET)
        msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
    else:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
