"""Text with a header of its own: LabVIEW's .lvm, and array files of piezo controllers.

The headers are read here, the rows below them as other text is.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from dehyst.adaptive.errors import InputError
from dehyst.sim.recordings.columns import ColumnMap
from dehyst.sim.recordings.delimited_text import read_lines
from dehyst.sim.recordings.table import Table
from dehyst.sim.recordings.text_cells import decode, is_number, split_cells

_GCS_LINE: Final = re.compile(r"#\s*([A-Za-z_]+\d*)\s*=\s*(.*?)\s*$")


def is_gcs(content: bytes) -> bool:
    """Whether a file begins as a controller's array file."""
    head = content[:8192].lstrip(b"\xef\xbb\xbf \r\n\t")
    return head.startswith(b"#") and (b"END_HEADER" in head or re.search(rb"#\s*NDATA\s*=", head) is not None)


def read_gcs(path: Path, content: bytes, mapping: ColumnMap) -> Table:
    """Array file of a piezo controller ("GCS array"): ``#`` header lines, then columns::

        # SEPARATOR = 32            ASCII code of the character between the columns
        # DIM = 2
        # SAMPLE_TIME = 0.000200
        # NDATA = 1024
        # NAME0 = Voltage Channel 1
        # NAME1 = Current Position Axis 1
        # END_HEADER
        1.2345 0.5678

    The names carry no units, so the mapping must say what they are. ``SAMPLE_TIME`` is in seconds by definition of the
    format. Raises InputError where header and data do not fit each other.
    """
    lines = decode(path, content).splitlines(keepends=True)
    start = next((k for k, line in enumerate(lines) if "END_HEADER" in line), None)
    if start is None:
        raise InputError(f"{path}: got no line '# END_HEADER', expected one before the data")
    matches = [_GCS_LINE.match(line.strip()) for line in lines[:start]]
    header = {match[1].upper(): match[2] for match in matches if match}
    columns = _gcs_integer(path, header, "DIM", 1)
    separator = mapping.delimiter or chr(_gcs_integer(path, header, "SEPARATOR", 1, default=32))
    layout = replace(mapping, header="none", delimiter=" " if separator in " \t" else separator)
    rows = list(read_lines(str(path), lines, layout).arrays.values())
    if len(rows) != columns:
        raise InputError(f"{path}: got {len(rows)} columns below the header, expected DIM = {columns}: is it whole?")
    notes = []
    declared = _gcs_integer(path, header, "NDATA", 0, default=rows[0].size)
    if declared != rows[0].size:
        notes.append(f"header announces NDATA = {declared} samples, the file holds {rows[0].size}")
    dt_s = None
    if "SAMPLE_TIME" in header:
        dt_s = float(header["SAMPLE_TIME"]) if is_number(header["SAMPLE_TIME"], ".") else float("nan")
        if not (0.0 < dt_s < 1e3):
            raise InputError(
                f"{path}: SAMPLE_TIME: got {header['SAMPLE_TIME']!r}, expected a positive time in s; or give --dt-s"
            )
        notes.append(f"sample time {dt_s:g} s from SAMPLE_TIME, in seconds by definition of the format")
    plain = [f"NAME{k}" for k in range(columns)]
    names = [header.get(name, name) for name in plain]
    names = names if len(set(names)) == columns else plain
    arrays = dict(zip(names, rows, strict=True))
    return Table(str(path), arrays, dt_s=dt_s, notes=tuple(notes), positional=True)


def _gcs_integer(path: Path, header: dict[str, str], key: str, least: int, default: int | None = None) -> int:
    text = header.get(key)
    if text is None and default is not None:
        return default
    if text is None or not text.isdigit() or int(text) < least:
        raise InputError(f"{path}: header line {key}: got {text!r}, expected a whole number of at least {least}")
    return int(text)


def is_lvm(content: bytes) -> bool:
    """Whether a file begins as a LabVIEW measurement file."""
    return content.lstrip(b"\xef\xbb\xbf").startswith(b"LabVIEW Measurement")


_END: Final = "***End_of_Header***"


def read_lvm(path: Path, content: bytes, mapping: ColumnMap) -> Table:
    """LabVIEW measurement file (.lvm): tagged lines up to ``***End_of_Header***``, then segments of channels::

        LabVIEW Measurement
        Separator   Tab
        X_Columns   One
        ***End_of_Header***
        Channels        2
        Y_Unit_Label    Volts   Microns
        Delta_X         0.001   0.001
        ***End_of_Header***
        X_Value drive   sensor  Comment
        0.000   1.25    12.5

    ``Y_Unit_Label`` gives the units, ``Delta_X`` the sample time in s where ``X_Dimension`` is Time. Segments of the
    same channels are put one after another. Raises InputError where header and data do not fit each other.
    """
    lines = decode(path, content).splitlines()
    ends = [k for k, line in enumerate(lines) if line.startswith(_END)]
    if not ends:
        raise InputError(f"{path}: got no line '{_END}', expected one before the data: is the file whole?")
    of_file = _lvm_tags(lines[: ends[0]], None)
    separator = mapping.delimiter or {"Comma": ","}.get(of_file.get("Separator", ["Tab"])[0], "\t")
    decimal = "," if of_file.get("Decimal_Separator", ["."])[0] == "," else mapping.decimal or "."
    #: The lines of names and of rows, at their places in the file; all others stay empty.
    kept = ["\n"] * len(lines)
    names: list[str] = []
    tags: dict[str, list[str]] = {}
    befores, heads, head = (ends[:-1], ends[1:], 0) if len(ends) > 1 else ([-1], ends, 0)
    for before, start, stop in zip(befores, heads, [*heads[1:], len(lines)], strict=True):
        found = _lvm_tags(lines[before + 1 : start], separator)
        rows = [k for k in range(start + 1, stop) if lines[k].strip()]
        if not rows:
            raise InputError(f"{path}: got no data after line {start + 1}, expected the channels' names and samples")
        cells = [cell for cell in split_cells(lines[rows[0]], separator) if cell != "Comment"]
        for what, got, expected in (
            ("channels", cells, names), ("Delta_X", found.get("Delta_X", []), tags.get("Delta_X", [])),
        ):  # fmt: skip
            if names and got != expected:
                raise InputError(
                    f"{path}: line {rows[0] + 1}: got {what} {', '.join(got)}, expected {', '.join(expected)} as in "
                    "the first segment: cut the file"
                )
        if not names:
            names, tags, head = cells, found, rows[0]
            kept[head] = separator.join(names) + "\n"
        for k in rows[1:]:
            row = lines[k].split(separator)[: len(names)]
            if row[0].strip() == "Channels" or row[0].startswith("***"):
                break  # the header of the next segment, or a special block
            kept[k] = separator.join(row + [""] * (len(names) - len(row))) + "\n"
    layout = replace(mapping, header=str(head + 1), delimiter=separator, decimal=decimal)
    return _lvm_table(read_lines(str(path), kept, layout), tags, len(heads), decimal)


def _lvm_tags(lines: list[str], separator: str | None) -> dict[str, list[str]]:
    """Tag -> its values, of a header."""
    found = {}
    for line in lines:
        tag, *values = split_cells(line, separator or ("\t" if "\t" in line else ","))
        found[tag] = [value for value in values if value]
    return found


def _lvm_table(table: Table, tags: dict[str, list[str]], segments: int, decimal: str) -> Table:
    """The table with units and sample time as the tags state them."""
    times = [name for name in table.arrays if name.partition(" (column ")[0] == "X_Value"]
    channels = [name for name in table.arrays if name not in times]
    over_time = set(tags.get("X_Dimension", ["Time"])) == {"Time"}
    units = dict.fromkeys(times, "s") if over_time else {}
    labels = tags.get("Y_Unit_Label", [])
    if len(labels) == len(channels):
        units |= dict(zip(channels, labels, strict=True))
    clocks: dict[str, tuple[float, float | None]] = {}
    steps = [text.replace(",", ".") if decimal == "," else text for text in tags.get("Delta_X", [])]
    if over_time and len(steps) == len(channels) and all(is_number(step, ".") for step in steps):
        clocks = {name: (float(step), None) for name, step in zip(channels, steps, strict=True)}
    if segments > 1:
        # Programs pause between segments: Delta_X is the clock of all only where the times go on without a pause.
        clock_s = [table.arrays[name] for name in times if table.arrays[name].dtype.kind == "f"]
        dt_s = max((clock[0] for clock in clocks.values()), default=np.inf)
        if not clock_s or any((np.abs(np.diff(t_s) - dt_s) > 0.5 * dt_s).any() for t_s in clock_s):
            clocks = {}
    notes = (f"{segments} segments put one after another",) if segments > 1 else ()
    return replace(table, notes=(*table.notes, *notes), units=units, clocks=clocks)
