"""The array files that piezo controllers write ("GCS array"): ``#`` header lines, then columns.

::

    # VERSION = 1
    # TYPE = 1
    # SEPARATOR = 32            ASCII code of what stands between the columns
    # DIM = 2
    # SAMPLE_TIME = 0.000200
    # NDATA = 1024
    # NAME0 = Voltage Channel 1
    # NAME1 = Current Position Axis 1
    # END_HEADER
    1.2345 0.5678

The names carry no units, so ``--column`` and ``--unit`` (or a map) say what they are. ``SAMPLE_TIME`` is in
seconds by the format's definition; ``--dt-s`` overrules it.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from adaptive.errors import InputError
from sim.recordings.columns import ColumnMap
from sim.recordings.formats import decode
from sim.recordings.table import Table

_LINE = re.compile(r"#\s*([A-Za-z_]+\d*)\s*=\s*(.*?)\s*$")


def is_gcs(content: bytes) -> bool:
    """Whether a text file begins as a controller's array file does."""
    head = content[:8192].lstrip(b"\xef\xbb\xbf \r\n\t")
    return head.startswith(b"#") and (b"END_HEADER" in head or re.search(rb"#\s*NDATA\s*=", head) is not None)


def read_gcs(path: Path, content: bytes, mapping: ColumnMap) -> Table:
    """Read a controller's array file. Raises InputError where header and data do not fit each other."""
    lines = decode(path, content).splitlines()
    header: dict[str, str] = {}
    start = None
    for number, line in enumerate(lines):
        if "END_HEADER" in line:
            start = number + 1
            break
        if match := _LINE.match(line.strip()):
            header[match.group(1).upper()] = match.group(2)
    if start is None:
        raise InputError(f"{path}: got no line '# END_HEADER', expected one before the data")
    columns = _whole(path, header, "DIM", 1)
    separator = mapping.delimiter or chr(_whole(path, header, "SEPARATOR", 1, default=32))
    rows = [line for line in lines[start:] if line.strip() and not line.lstrip().startswith("#")]
    values = np.empty((len(rows), columns))
    for number, line in enumerate(rows):
        cells = line.split() if separator in " \t" else line.split(separator)
        cells = [cell for cell in cells if cell.strip()]
        try:
            values[number] = [float(cell.replace(",", ".") if mapping.decimal == "," else cell) for cell in cells]
        except ValueError as error:
            raise InputError(
                f"{path}: data row {number + 1}: got {line.strip()[:60]!r}, expected DIM = {columns} numbers"
            ) from error
    notes = []
    declared = _whole(path, header, "NDATA", 0, default=len(rows))
    if declared != len(rows):
        notes.append(f"header announces NDATA = {declared} samples, the file holds {len(rows)}")
    dt_s = None
    if "SAMPLE_TIME" in header:
        try:
            dt_s = float(header["SAMPLE_TIME"])
        except ValueError:
            dt_s = float("nan")
        if not (0.0 < dt_s < 1e3):
            raise InputError(
                f"{path}: SAMPLE_TIME: got {header['SAMPLE_TIME']!r}, expected a positive time in s; or give --dt-s"
            )
        notes.append(f"sample time {dt_s:g} s from SAMPLE_TIME, in seconds by the format's definition")
    names = [header.get(f"NAME{k}", f"NAME{k}") for k in range(columns)]
    if len(set(names)) < len(names):
        names = [f"NAME{k}" for k in range(columns)]
    arrays = {name: values[:, k] for k, name in enumerate(names)}
    return Table(str(path), arrays, dt_s=dt_s, notes=tuple(notes))


def _whole(path: Path, header: dict[str, str], key: str, least: int, default: int | None = None) -> int:
    text = header.get(key)
    if text is None and default is not None:
        return default
    if text is None or not text.isdigit() or int(text) < least:
        raise InputError(f"{path}: header line {key}: got {text!r}, expected a whole number of at least {least}")
    return int(text)
