"""Compare the sizes that numpy files declare with the bytes they have, before numpy allocates memory for them."""

from __future__ import annotations

import math
import zipfile
from typing import IO, Any

from numpy.lib import format as npy


def check_npy(stream: IO[bytes], size: int) -> None:
    """Raise ValueError where ``.npy`` data of ``size`` bytes declare more values than they have; reads the header.

    numpy itself refuses arrays of objects (``allow_pickle=False``).
    """
    read_header: Any = npy.read_array_header_1_0 if npy.read_magic(stream) == (1, 0) else npy.read_array_header_2_0
    shape, _, dtype = read_header(stream)
    declared, there = math.prod(shape) * max(dtype.itemsize, 1), size - stream.tell()
    if declared > there and not dtype.hasobject:
        raise ValueError(f"declares {dtype} of shape {str(shape)[:80]}, {declared} bytes, but has {there}")


def check_npz(archive: zipfile.ZipFile, most_bytes: int) -> None:
    """Raise ValueError where an ``.npz`` archive unpacks to more than ``most_bytes``, or an array declares more.

    zipfile reads no more of a member than it declares, so that nothing unpacks to more later.
    """
    size = sum(entry.file_size for entry in archive.infolist())
    if size > most_bytes:
        raise ValueError(f"unpacks to {size} bytes, expected at most {most_bytes}")
    for entry in archive.infolist():
        with archive.open(entry) as member:
            # numpy reads any member that begins like an array as one, whatever its name.
            if member.read(len(npy.MAGIC_PREFIX)) != npy.MAGIC_PREFIX:
                continue
            member.seek(0)
            try:
                check_npy(member, entry.file_size)
            except ValueError as error:
                raise ValueError(f"{entry.filename.removesuffix('.npy')}: {error}") from error
