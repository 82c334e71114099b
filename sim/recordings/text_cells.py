"""Text: its encoding, and the cells of a line as names, units and numbers."""

from __future__ import annotations

import codecs
import csv
import gzip
import io
import re
from pathlib import Path
from typing import TextIO

from dehyst.adaptive.errors import InputError
from dehyst.sim.recordings.columns import is_unit


def different(names: list[str]) -> list[str]:
    """``names``, each that stands there several times with its position, so that none hides another."""
    return [
        name if name and names.count(name) == 1 else f"{name or 'unnamed'} (column {k})"
        for k, name in enumerate(names, 1)
    ]


def units_row(names: list[str], cells: list[str]) -> dict[str, str]:
    """name -> unit from the row below the names; empty unless most cells are units, or empty, and the rest texts."""
    bare = [cell.strip("[]() ") for cell in cells]
    filled = [cell for cell in bare if cell]
    known = sum(map(is_unit, filled))
    if len(bare) != len(names) or 2 * known <= len(filled) or any(is_number(cell, ".") for cell in filled):
        return {}
    return {name: cell for name, cell in zip(names, bare, strict=True) if cell}


def split_cells(line: str, delimiter: str) -> list[str]:
    """The cells of a line of text, without blanks and quotes around them; a blank delimiter means any blanks.

    A delimiter between quotes is part of its cell.
    """
    if '"' in line and delimiter != " " and line.count('"') % 2 == 0:
        try:
            cells = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))
        except csv.Error:
            cells = line.split(delimiter)
    else:
        cells = line.split() if delimiter == " " else line.split(delimiter)
    return [cell.strip().strip('"') for cell in cells]


def is_packed(path: Path) -> bool:
    """Whether a file begins as one packed by gzip."""
    with path.open("rb") as file:
        return file.read(2) == b"\x1f\x8b"


def opened_bytes(path: Path) -> gzip.GzipFile | io.BufferedReader:
    """The bytes of a file, unpacked where gzip has packed it."""
    return gzip.open(path) if is_packed(path) else path.open("rb")


def opened(path: Path, encoding: str) -> TextIO:
    """A file of text, unpacked where gzip has packed it."""
    return io.TextIOWrapper(opened_bytes(path), encoding=encoding, newline=None)


def encoding_of(path: Path, head: bytes) -> str:
    """The encoding of a text by its beginning: UTF-8, UTF-16 with its mark, else Latin-1.

    Latin-1 has the µ and ° of old controllers. Raises InputError where it is no text.
    """
    for mark, name in (
        (codecs.BOM_UTF8, "utf-8-sig"),
        (codecs.BOM_UTF16_LE, "utf-16"),
        (codecs.BOM_UTF16_BE, "utf-16"),
    ):
        if head.startswith(mark):
            return name
    if 0 in head:
        raise InputError(f"{path}: is not text, expected text, .parquet, .mat, .h5, .npy, .npz, .tdms or .xlsx")
    try:
        # A letter may be cut in two at the end.
        codecs.getincrementaldecoder("utf-8")().decode(head)
    except UnicodeDecodeError:
        return "latin-1"
    return "utf-8"


#: The exponent of Fortran's double precision, and the minus sign that spreadsheets of some countries write.
_EXPONENT_D = re.compile(r"(?<=[\d.])[dD](?=[+-]\d+$)")
_MINUS = str.maketrans("\N{MINUS SIGN}", "-")


def plain_number(text: str) -> str:
    """A cell as Python reads it: with a plain minus sign and exponent."""
    return _EXPONENT_D.sub("e", text.translate(_MINUS))


def is_number(text: str, decimal: str | None) -> bool:
    """Whether a cell of text is a number with this decimal sign."""
    if "_" in text:  # which Python reads, and no instrument writes
        return False
    plain = plain_number(text)
    try:
        float(plain.replace(",", ".") if decimal == "," else plain)
    except ValueError:
        return False
    return True
