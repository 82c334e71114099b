"""Text: what all readers of it share, LabVIEW's .lvm, and array files of piezo controllers."""

from __future__ import annotations

import codecs
import csv
import gzip
import io
import re
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray

from dehyst.adaptive.errors import InputError
from dehyst.sim.recordings.columns import ColumnMap, is_unit
from dehyst.sim.recordings.table import Table, seconds


def has_names(source: str, cells: list[str], mapping: ColumnMap, number: int) -> bool:
    """Whether the first line of a table holds names; False where it is a sample.

    ``number`` is its number in the file. Raises InputError where it may be both.
    """
    if mapping.header is not None:
        return mapping.header != "none"
    filled = [cell for cell in cells if cell]
    numbers = [cell for cell in filled if is_number(cell, mapping.decimal)]
    settle = f"add --header {number} if this line holds the columns' names, or --header none if it is a sample"
    if filled and len(numbers) == len(filled):
        if numbers in ([str(k + origin) for k in range(len(cells))] for origin in (0, 1)):
            raise InputError(
                f"{source}: got {', '.join(numbers)} in line {number}, which may be names of columns or a sample: "
                f"{settle}"
            )
        return False
    if numbers:
        raise InputError(
            f"{source}: got names and numbers in line {number} ({', '.join(filled)[:80]}), expected one of the two: "
            f"{settle}"
        )
    return True


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
    """The encoding of a text by its beginning: UTF-8 or UTF-16 with or without a mark, else Latin-1.

    Latin-1 has the µ and ° of old controllers. Raises InputError where it is no text.
    """
    for mark, name in (
        (codecs.BOM_UTF8, "utf-8-sig"),
        (codecs.BOM_UTF16_LE, "utf-16"),
        (codecs.BOM_UTF16_BE, "utf-16"),
    ):
        if head.startswith(mark):
            return name
    zeros = [head[k:4096:2].count(0) for k in (0, 1)]
    if any(zeros):
        # Every second byte of plain letters in UTF-16 is zero.
        half = min(len(head), 4096) // 2
        for name, (many, few) in (("utf-16-le", (zeros[1], zeros[0])), ("utf-16-be", (zeros[0], zeros[1]))):
            if few == 0 and many > 0.9 * half:
                return name
        raise InputError(f"{path}: is not text, expected text, .parquet, .mat, .h5, .npy, .npz, .tdms or .xlsx")
    try:
        # A letter may be cut in two at the end.
        codecs.getincrementaldecoder("utf-8")().decode(head)
    except UnicodeDecodeError:
        return "latin-1"
    return "utf-8"


def decode(path: Path, content: bytes) -> str:
    """A whole file of text; see `encoding_of`."""
    try:
        return content.decode(encoding_of(path, content))
    except UnicodeDecodeError:
        return content.decode("latin-1")


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


def from_arrow(column: Any) -> tuple[NDArray[Any], bool]:
    """A column of pyarrow as an array, and whether it held times, which become seconds.

    Timestamps count from the first one, durations and times of day from zero.
    """
    import pyarrow as pa

    if pa.types.is_time(column.type):
        since_midnight = pa.int64() if pa.types.is_time64(column.type) else pa.int32()
        column = column.cast(since_midnight).cast(pa.int64()).cast(pa.duration(column.type.unit))
    if pa.types.is_duration(column.type):
        return seconds(column.cast(pa.duration("ns")).to_numpy().astype("timedelta64[ns]")), True
    if pa.types.is_timestamp(column.type):
        return seconds(column.cast(pa.timestamp("ns")).to_numpy().astype("datetime64[ns]")), True
    if pa.types.is_decimal(column.type):
        column = column.cast(pa.float64())
    if pa.types.is_null(column.type):
        return np.full(len(column), np.nan), False
    if pa.types.is_dictionary(column.type):
        column = column.cast(column.type.value_type)
    return np.asarray(column.to_numpy()), False


_GCS_LINE = re.compile(r"#\s*([A-Za-z_]+\d*)\s*=\s*(.*?)\s*$")


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
    lines = decode(path, content).splitlines()
    header: dict[str, str] = {}
    start = None
    for number, line in enumerate(lines):
        if "END_HEADER" in line:
            start = number + 1
            break
        if match := _GCS_LINE.match(line.strip()):
            header[match.group(1).upper()] = match.group(2)
    if start is None:
        raise InputError(f"{path}: got no line '# END_HEADER', expected one before the data")
    columns = _gcs_integer(path, header, "DIM", 1)
    separator = mapping.delimiter or chr(_gcs_integer(path, header, "SEPARATOR", 1, default=32))
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
    declared = _gcs_integer(path, header, "NDATA", 0, default=len(rows))
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
        notes.append(f"sample time {dt_s:g} s from SAMPLE_TIME, in seconds by definition of the format")
    names = [header.get(f"NAME{k}", f"NAME{k}") for k in range(columns)]
    if len(set(names)) < len(names):
        names = [f"NAME{k}" for k in range(columns)]
    arrays = {name: values[:, k] for k, name in enumerate(names)}
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
    ends = [k for k, line in enumerate(lines) if line.startswith("***End_of_Header***")]
    if not ends:
        raise InputError(f"{path}: got no line '***End_of_Header***', expected one before the data: is the file whole?")
    file_tags = _lvm_tags(lines[: ends[0]], None)
    separator = mapping.delimiter or {"Comma": ","}.get(file_tags.get("Separator", ["Tab"])[0], "\t")
    decimal = "," if file_tags.get("Decimal_Separator", ["."])[0] == "," else mapping.decimal or "."
    names: list[str] = []
    tags: dict[str, list[str]] = {}
    rows: list[list[float]] = []
    segments = 0
    for start, stop in zip(ends[1:] or ends, [*ends[2:], len(lines)], strict=True):
        before = max(end for end in [*ends, -1] if end < start) if start != ends[0] else -1
        found = _lvm_tags(lines[before + 1 : start], separator)
        table = [(k, line) for k, line in enumerate(lines[start + 1 : stop], start + 2) if line.strip()]
        if not table:
            raise InputError(f"{path}: got no data after line {start + 1}, expected the channels' names and samples")
        cells = split_cells(table[0][1], separator)
        if segments and cells != names:
            raise InputError(
                f"{path}: line {table[0][0]}: got channels {', '.join(cells)}, expected {', '.join(names)} as in the "
                "first segment: cut the file"
            )
        if segments and found.get("Delta_X") != tags.get("Delta_X"):
            raise InputError(
                f"{path}: line {start + 1}: got Delta_X {found.get('Delta_X')}, expected {tags.get('Delta_X')} as in "
                "the first segment: cut the file"
            )
        names, tags, segments = cells, tags or found, segments + 1
        rows += _lvm_rows(path, table[1:], len([name for name in names if name != "Comment"]), separator, decimal)
    return _lvm_table(path, names, tags, np.asarray(rows), segments, decimal)


def _lvm_tags(lines: list[str], separator: str | None) -> dict[str, list[str]]:
    """Tag -> its values, of a header."""
    found = {}
    for line in lines:
        tag, *values = split_cells(line, separator or ("\t" if "\t" in line else ","))
        found[tag] = [value for value in values if value]
    return found


def _lvm_rows(path: Path, table: list[tuple[int, str]], width: int, separator: str, decimal: str) -> list[list[float]]:
    rows = []
    for number, line in table:
        cells = [cell.strip() for cell in line.split(separator)]
        if cells[0] == "Channels" or cells[0].startswith("***"):
            break  # the header of the next segment, or a special block
        cells = (cells + [""] * width)[:width]
        try:
            rows.append([float(c.replace(",", ".") if decimal == "," else c) if c else np.nan for c in cells])
        except ValueError as error:
            raise InputError(f"{path}: line {number}: got {line.strip()[:60]!r}, expected {width} numbers") from error
    return rows


def _lvm_table(
    path: Path, names: list[str], tags: dict[str, list[str]], rows: NDArray[np.float64], segments: int, decimal: str
) -> Table:
    names = [name for name in names if name != "Comment"]
    if not len(rows):
        raise InputError(f"{path}: got no samples below the channels' names, expected one row per sample")
    called = different(names)
    # Where X_Columns is No, the column of the times stays empty.
    arrays = {
        name: rows[:, k] for k, name in enumerate(called) if names[k] != "X_Value" or not np.isnan(rows[:, k]).all()
    }
    channels = [name for k, name in enumerate(called) if names[k] != "X_Value"]
    over_time = set(tags.get("X_Dimension", ["Time"])) == {"Time"}
    units = {name: "s" for k, name in enumerate(called) if names[k] == "X_Value" and over_time}
    labels = tags.get("Y_Unit_Label", [])
    if len(labels) == len(channels):
        units |= dict(zip(channels, labels, strict=True))
    clocks: dict[str, tuple[float, float | None]] = {}
    steps = [text.replace(",", ".") if decimal == "," else text for text in tags.get("Delta_X", [])]
    if over_time and len(steps) == len(channels) and all(is_number(step, ".") for step in steps):
        clocks = {name: (float(step), None) for name, step in zip(channels, steps, strict=True)}
    if segments > 1:
        # Programs pause between segments: Delta_X is the clock of all only where the times go on without a pause.
        times = [arrays[name] for name in called if name in arrays and name not in channels]
        dt_s = max((clock[0] for clock in clocks.values()), default=np.inf)
        if not times or any((np.abs(np.diff(t_s) - dt_s) > 0.5 * dt_s).any() for t_s in times):
            clocks = {}
    notes = (f"{segments} segments put one after another",) if segments > 1 else ()
    return Table(str(path), arrays, notes=notes, units=units, clocks=clocks, positional=True)
