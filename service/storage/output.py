"""Files of the service are written at once: atomic writes, and output folders without results of an earlier run."""

from __future__ import annotations

import contextlib
import errno
import os
import secrets
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import BinaryIO, Final

from dehyst.adaptive.errors import InputError

# --- Atomic file writing: a reader sees the old file or the new one, never a part.

#: Suffix of a file that is not complete. Its name begins with a dot, so that readers of a whole folder skip it.
PART: Final = ".part"


@contextlib.contextmanager
def atomic_write(path: Path, mode: int = 0o666) -> Iterator[BinaryIO]:
    """Open a binary file that replaces ``path`` when the block ends without an exception.

    When the block ends, the content and the name of the file are on the disk: both the file and its folder are synced.
    After an exception ``path`` is unchanged and the partial file is removed. Only a killed process leaves the partial
    file ``.NAME.XXXXXXXX.part`` behind.

    Parameters
    ----------
    path : file to write or to replace. Its folder must exist.
    mode : permissions of the new file, before the umask.

    Raises OSError as the disk does.
    """
    part = path.with_name(f".{path.name}.{secrets.token_hex(4)}{PART}")
    try:
        with os.fdopen(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    except BaseException as error:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.errno is not None and error.filename is None:
            raise OSError(error.errno, error.strerror, str(path)) from error  # a full disk does not say of what
        raise
    _sync_folder(path.parent)


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


# --- Appending to a file of lines.


def append_line(path: Path, line: bytes) -> None:
    """Append a whole ``line`` and sync it to the disk; its folder is made where it is missing. Raises OSError.

    One write in append mode: lines of two processes do not mix. A line that a full disk or a crash cut off is ended
    first: it must not spoil this one.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    handle = os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT, 0o644)
    try:
        end = os.lseek(handle, 0, os.SEEK_END)
        if end and os.lseek(handle, end - 1, os.SEEK_SET) >= 0 and os.read(handle, 1) != b"\n":
            line = b"\n" + line
        if os.write(handle, line) != len(line):
            raise OSError(errno.ENOSPC, "incomplete write")
        os.fsync(handle)
    finally:
        os.close(handle)


# --- Checks and prepares the output of a command: it is writable, and a folder holds no results of an earlier run.


def check_file(option: str, path: Path) -> None:
    """Raise InputError unless a file ``path`` can be written, before anything is computed for it."""
    try:
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, "it is a folder")
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise InputError(
            f"{option}: got {path}, expected a file in a folder that can be written to: {error.strerror}; "
            f"make {path.parent}, or name another"
        ) from error


def check_folder(out: Path) -> None:
    """Raise InputError unless a folder ``out`` can be written to or made, before anything is computed for it."""
    there = next(place for place in (out, *out.absolute().parents) if place.exists())
    try:
        with tempfile.TemporaryFile(dir=there):
            pass
    except OSError as error:
        raise InputError(f"--out: got {out}, expected a folder that can be written to: {error.strerror}") from error


def clear_output(out: Path, names: Iterable[str] = ()) -> None:
    """Create ``out`` if missing, and remove the files and folders called ``names`` in it; others stay.

    Raises InputError if the folder cannot be written to.
    """
    check_folder(out)
    try:
        out.mkdir(parents=True, exist_ok=True)
        for name in names:
            path = out / name
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"--out: got {out}, expected a folder that can be written to: {error}") from error
