"""Readers of file formats, each giving a `Table`: delimited text, Parquet, MATLAB, npz, and controller array files."""

from __future__ import annotations

import io
import re
import zipfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptive.errors import InputError
from adaptive.types import FloatArray
from sim.recordings.columns import ColumnMap


@dataclass(frozen=True, slots=True)
class Table:
    """The arrays of a file by the names that the file gives them, before their meaning is known.

    Attributes
    ----------
    source : the file, for messages.
    arrays : name -> array of any shape and type.
    dt_s : sample time, s, where the format defines one.
    notes : remarks of the reader, for people.
    """

    source: str
    arrays: dict[str, NDArray[Any]]
    dt_s: float | None = None
    notes: tuple[str, ...] = field(default=())

    def describe(self) -> str:
        """The names, with the shapes of arrays that are not plain columns."""
        parts = [n if a.ndim == 1 else f"{n}{list(a.shape) if a.ndim else ''}" for n, a in self.arrays.items()]
        return ", ".join(parts) or "nothing"

    def _array(self, quantity: str, name: str) -> NDArray[Any]:
        if name not in self.arrays:
            raise InputError(
                f"{self.source}: got no column {name!r} for {quantity}; the file holds {self.describe()}: "
                f"choose with --column {quantity}=NAME"
            )
        return self.arrays[name]

    def scalar(self, quantity: str, name: str) -> float:
        """A single number. Raises InputError where the array is anything else."""
        array = self._array(quantity, name)
        try:
            value = float(np.asarray(array, dtype=np.float64).reshape(-1)[0]) if array.size == 1 else np.nan
        except (TypeError, ValueError):
            value = np.nan
        if not np.isfinite(value):
            raise InputError(f"{self.source}: {name!r} for {quantity}: expected a single finite number")
        return value

    def column(self, quantity: str, name: str, index: str | None) -> FloatArray:
        """(n,) float64; an array of several dimensions needs an index such as ``":,0,2"``. Raises InputError."""
        array = self._array(quantity, name)
        if index is not None:
            array = array[_parse_index(self.source, quantity, name, array.shape, index)]
        elif array.ndim == 2 and 1 in array.shape:
            array = array.reshape(-1)
        if array.ndim != 1:
            example = ",".join([":"] + ["0"] * (array.ndim - 1))
            raise InputError(
                f"{self.source}: {name!r} for {quantity} has shape {array.shape}, expected one value per sample: "
                f"choose with --index {quantity}={example} (one ':' for the samples)"
            )
        try:
            return np.ascontiguousarray(array, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise InputError(f"{self.source}: column {name!r} for {quantity}: {_first_text(array)}") from error


def _first_text(array: NDArray[Any]) -> str:
    """The first value that is not a number, with its data row (counted from 1)."""
    for row, value in enumerate(array.tolist(), 1):
        try:
            float(value)
        except (TypeError, ValueError):
            return f"got {value!r} in data row {row}, expected a number"
    return "got values that are not numbers"


def _parse_index(source: str, quantity: str, name: str, shape: tuple[int, ...], text: str) -> tuple[slice | int, ...]:
    fail = InputError(
        f"{source}: index of {quantity}: got {text!r} for {name!r} of shape {shape}, expected {len(shape)} entries, "
        "one ':' for the samples and whole numbers within the shape for the rest"
    )
    entries = [entry.strip() for entry in text.split(",")]
    if len(entries) != len(shape) or entries.count(":") != 1:
        raise fail
    chosen: list[slice | int] = []
    for entry, size in zip(entries, shape, strict=True):
        if entry == ":":
            chosen.append(slice(None))
        elif entry.isdigit() and int(entry) < size:
            chosen.append(int(entry))
        else:
            raise fail
    return tuple(chosen)


def read_text(path: Path, content: bytes, mapping: ColumnMap) -> Table:
    """Delimited text with a header line; lines before it that start with ``#`` or ``%`` are comments."""
    import pyarrow as pa
    from pyarrow import csv

    text = decode(path, content)
    lines = text.splitlines()
    first = next((k for k, line in enumerate(lines) if line.strip() and line.lstrip()[0] not in "#%"), None)
    if first is None:
        raise InputError(f"{path}: got no data, expected a header line and one row per sample")
    header = lines[first]
    delimiter = mapping.delimiter or next((d for d in "\t;," if d in header), " ")
    body = "\n".join(lines[first:])
    if delimiter == " ":
        body, delimiter = re.sub(r"[^\S\n]+", "\t", re.sub(r"(?m)^[^\S\n]+|[^\S\n]+$", "", body)), "\t"
        header = body.split("\n", 1)[0]
    names = [name.strip().strip('"') for name in header.split(delimiter)]
    if all(_is_number(name, mapping.decimal) for name in names):
        raise InputError(
            f"{path}: got numbers in its first line, expected a header line with the columns' names and units, "
            "such as t_s,u_V,y_um: add one"
        )
    doubled = sorted({name for name in names if names.count(name) > 1})
    if doubled:
        raise InputError(f"{path}: got column {doubled[0]!r} twice, expected different names")
    try:
        table = csv.read_csv(
            io.BytesIO(body.split("\n", 1)[1].encode() if "\n" in body else b""),
            read_options=csv.ReadOptions(column_names=names),
            parse_options=csv.ParseOptions(delimiter=delimiter),
            convert_options=csv.ConvertOptions(decimal_point=mapping.decimal, strings_can_be_null=True),
        )
    except pa.ArrowInvalid as error:
        hint = "" if "Empty" not in str(error) else ": the file has a header line and no samples"
        raise InputError(f"{path}: is not a table of {len(names)} columns{hint} ({error})") from error
    return Table(str(path), {name: _from_arrow(table.column(name)) for name in names})


def read_parquet(path: Path, content: bytes) -> Table:
    """Parquet; a column of timestamps becomes seconds since its first value."""
    import pyarrow as pa
    from pyarrow import parquet

    try:
        # No thread pool: pyarrow aborts a process that ends right after the pool was started.
        table = parquet.ParquetFile(io.BytesIO(content), pre_buffer=False).read(use_threads=False)
    except (pa.ArrowInvalid, OSError) as error:
        raise InputError(f"{path}: is not a whole Parquet file ({error})") from error
    return Table(str(path), {name: _from_arrow(table.column(name)) for name in table.column_names})


def read_mat(path: Path, content: bytes) -> Table:
    """MATLAB files of version 4 to 7; fields of structures get dotted names (``rec.u``)."""
    from scipy.io import loadmat

    try:
        variables = loadmat(io.BytesIO(content), squeeze_me=True)
    except NotImplementedError as error:
        raise InputError(
            f"{path}: is a MATLAB 7.3 file (HDF5), expected version 7 or older: in MATLAB, load it and call "
            f"save('{path.stem}_v7.mat', '-v7')"
        ) from error
    except Exception as error:  # scipy raises many kinds of errors on a damaged file
        raise InputError(f"{path}: is not a whole .mat file ({error})") from error
    arrays: dict[str, NDArray[Any]] = {}
    for name, value in variables.items():
        if not name.startswith("__"):
            _flatten(name, np.asarray(value), arrays)
    return Table(str(path), arrays)


def _flatten(name: str, value: NDArray[Any], into: dict[str, NDArray[Any]]) -> None:
    """Add a numeric array, or each field of a structure; tables and objects are left out."""
    if value.dtype.names is not None and value.ndim == 0:
        for field in value.dtype.names:
            _flatten(f"{name}.{field}", np.asarray(value[field].item()), into)
    elif value.dtype.kind in "fiub":
        into[name] = value


def read_npz(path: Path, content: bytes) -> Table:
    """numpy archives. Pickled objects are refused."""
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            return Table(str(path), {name: archive[name] for name in archive.files})
    except (ValueError, OSError, EOFError, KeyError, zipfile.BadZipFile, AttributeError, TypeError) as error:
        raise InputError(f"{path}: is not a whole .npz file of plain arrays ({error})") from error


def decode(path: Path, content: bytes) -> str:
    """Text in UTF-8 (with or without mark), UTF-16 with mark, or Latin-1 (µ and ° of old controllers)."""
    if content[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return content.decode("utf-16")
    if b"\x00" in content[:4096]:
        raise InputError(f"{path}: is not text, expected .csv, .parquet, .mat, .npz or a controller's array file")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("latin-1")


def _is_number(text: str, decimal: str) -> bool:
    try:
        float(text.replace(decimal, ".") if decimal == "," else text)
    except ValueError:
        return False
    return True


def _from_arrow(column: Any) -> NDArray[Any]:
    import pyarrow as pa

    if pa.types.is_timestamp(column.type):
        ticks = column.cast(pa.timestamp("ns")).to_numpy().astype("datetime64[ns]").astype(np.int64)
        return np.asarray((ticks - ticks[0]) * 1e-9 if len(ticks) else ticks, dtype=np.float64)
    if pa.types.is_decimal(column.type):
        column = column.cast(pa.float64())
    if pa.types.is_null(column.type):
        return np.full(len(column), np.nan)
    if pa.types.is_dictionary(column.type):
        column = column.cast(column.type.value_type)
    return np.asarray(column.to_numpy())


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
    return Table(str(path), arrays, dt_s=dt_s, notes=tuple(notes))


def _gcs_integer(path: Path, header: dict[str, str], key: str, least: int, default: int | None = None) -> int:
    text = header.get(key)
    if text is None and default is not None:
        return default
    if text is None or not text.isdigit() or int(text) < least:
        raise InputError(f"{path}: header line {key}: got {text!r}, expected a whole number of at least {least}")
    return int(text)
