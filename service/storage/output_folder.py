"""Prepares the output folder of a command: it exists, is writable, and holds no results of an earlier run."""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from pathlib import Path

from adaptive.errors import InputError


def clear_output(out: Path, names: Iterable[str]) -> None:
    """Create ``out`` if missing, and remove the files and folders called ``names`` in it; others stay.

    Raises InputError if the folder cannot be written to.
    """
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
