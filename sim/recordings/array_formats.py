"""Readers of binary files: Parquet, MATLAB, HDF5, numpy, TDMS and Excel workbooks. Nothing in a file is executed.

h5py, npTDMS and openpyxl are imported when a file of theirs is read.
"""

from __future__ import annotations

import io
import json
import logging
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptive.errors import InputError
from sim.recordings.columns import ColumnMap
from sim.recordings.table import MAX_BYTES, Table, plain_arrays
from sim.recordings.text_formats import different, from_arrow, has_names, units_row

HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
#: MATLAB puts a text header of this length before the HDF5 data of version 7.3.
_MATLAB_HEADER = 512
_MATLAB_4_HEADER = 20
#: Time to read a MATLAB file of version 4 to 7: to start the process on a busy machine, s, and bytes per second.
MATLAB_TIME_S, _MATLAB_BYTES_PER_S = 60.0, 5e6
#: Most memory of the process that reads it: the file, its arrays, and the interpreter with scipy.
MATLAB_MEMORY_BYTES = 3 * MAX_BYTES
#: Deepest nesting of groups in an HDF5 file, and most of its members: more is a loop of links.
_DEEPEST, _MOST_MEMBERS = 16, 10_000


def read_parquet(path: Path, content: bytes) -> Table:
    """Parquet; a column of timestamps becomes seconds since its first value."""
    import pyarrow as pa
    from pyarrow import parquet

    try:
        # No thread pool: pyarrow aborts a process that ends right after the pool was started.
        table = parquet.ParquetFile(io.BytesIO(content), pre_buffer=False).read(use_threads=False)
    except (pa.ArrowException, OSError) as error:
        raise InputError(f"{path}: is not a whole Parquet file ({error})") from error
    columns = {name: from_arrow(table.column(name)) for name in table.column_names}
    units = {name: "s" for name, (_, stamped) in columns.items() if stamped}
    return Table(str(path), {name: array for name, (array, _) in columns.items()}, units=units)


def read_mat(path: Path, content: bytes) -> Table:
    """MATLAB files of all versions; fields of structures get dotted names (``rec.u``).

    Versions 4 to 7 are read in a process of their own, which a damaged file may end (`matlab_process`).
    """
    if content[_MATLAB_HEADER : _MATLAB_HEADER + len(HDF5_SIGNATURE)] == HDF5_SIGNATURE:
        return read_hdf5(path, content)
    # Version 4 begins with a number of four bytes, versions 5 to 7 with a text and the order of bytes behind it.
    if len(content) < _MATLAB_4_HEADER or not (0 in content[:4] or content[126:128] in (b"IM", b"MI")):
        raise InputError(f"{path}: is not a .mat file (no header of MATLAB's), expected a recording")
    command = [sys.executable, "-P", str(Path(__file__).with_name("matlab_process.py")), str(MATLAB_MEMORY_BYTES)]
    limit_s = MATLAB_TIME_S + len(content) / _MATLAB_BYTES_PER_S
    try:
        done = subprocess.run(command, input=content, capture_output=True, timeout=limit_s, check=False)
    except subprocess.TimeoutExpired as error:
        raise InputError(
            f"{path}: is not a whole .mat file (not read within {limit_s:.0f} s), expected a recording: save it again"
        ) from error
    try:
        if done.returncode:
            said = done.stderr.decode("utf-8", "replace").strip().splitlines()
            raise ValueError(f"its reader ended with {done.returncode}{f': {said[-1][:200]}' if said else ''}")
        answer = io.BytesIO(done.stdout)
        line = json.loads(answer.readline())
        if "error" in line:
            if line["kind"] == "NotImplementedError":
                raise InputError(
                    f"{path}: announces MATLAB 7.3 (HDF5) and holds no HDF5 data, expected a whole file: save it again"
                )
            raise ValueError(line["error"] or line["kind"])
        arrays = {name: np.lib.format.read_array(answer, allow_pickle=False) for name in line["names"]}
    except ValueError as error:
        raise InputError(f"{path}: is not a whole .mat file ({error}), expected one: save it again") from error
    return Table(str(path), arrays, left_out=tuple(line["left_out"]))


def read_hdf5(path: Path, content: bytes) -> Table:
    """HDF5, among it MATLAB 7.3; members of groups and fields of structures get dotted names (``rec.u``).

    MATLAB's arrays get their dimensions in MATLAB's order. An attribute ``units`` or ``unit`` states the unit. Links to
    other files are not followed.
    """
    h5py = _library("h5py", path)
    try:
        with h5py.File(io.BytesIO(content), "r") as file:
            reading = _Hdf5(path, h5py)
            reading.add(file, "", 0)
    except InputError:
        raise
    except Exception as error:  # h5py raises many kinds of errors on a damaged file
        raise InputError(f"{path}: is not a whole HDF5 file ({_line(error)})") from error
    return Table(str(path), reading.arrays, units=reading.units, left_out=tuple(reading.left_out))


class _Hdf5:
    """Collects the arrays of numbers in an open HDF5 file."""

    def __init__(self, path: Path, h5py: Any) -> None:
        self.path = path
        self.h5py = h5py
        self.arrays: dict[str, NDArray[Any]] = {}
        self.units: dict[str, str] = {}
        self.left_out: list[str] = []
        self.members = 0
        self.bytes = 0

    def add(self, group: Any, prefix: str, depth: int) -> None:
        for key in group:
            if key.startswith("#"):  # MATLAB's own store of cells and objects
                continue
            name = f"{prefix}{key}"
            self.members += 1
            if self.members > _MOST_MEMBERS or depth > _DEEPEST:
                raise InputError(
                    f"{self.path}: got more than {_MOST_MEMBERS} members or {_DEEPEST} levels of groups, expected a "
                    "recording: copy the arrays into a file of their own"
                )
            if not isinstance(group.get(key, getlink=True), self.h5py.HardLink):
                self.left_out.append(f"{name} (a link)")
                continue
            member = group[key]
            if isinstance(member, self.h5py.Group):
                self.add(member, f"{name}.", depth + 1)
            elif reason := self._unreadable(member):
                self.left_out.append(f"{name} ({reason})")
            else:
                self._add_array(name, member)

    def _unreadable(self, member: Any) -> str:
        """Why a member holds no array of numbers; "" where it does."""
        if not isinstance(member, self.h5py.Dataset):
            return "no array"
        if member.is_virtual or member.external:
            return "its values are in another file"
        matlab = _text(member.attrs.get("MATLAB_class", ""))
        if "MATLAB_empty" in member.attrs:
            return "empty"
        if matlab and matlab not in ("double", "single", "logical") and not matlab.startswith(("int", "uint")):
            return {"char": "text", "cell": "cells"}.get(matlab, f"a {matlab}") + (
                "" if matlab != "struct" else " array"
            )
        if member.dtype.kind in "fiub" or _is_complex(member.dtype):
            return ""
        return "no numbers"

    def _add_array(self, name: str, member: Any) -> None:
        # Compressed data may unpack to a thousand times the file.
        self.bytes += member.size * member.dtype.itemsize
        if self.bytes > MAX_BYTES:
            raise InputError(
                f"{self.path}: its arrays take more than {MAX_BYTES / 1e9:g} GB unpacked ({name} has shape "
                f"{member.shape}), expected at most that: copy the recording into a file of its own"
            )
        array = np.asarray(member[()])
        if array.dtype.names is not None:
            array = array["real"] + 1j * array["imag"]
        if "MATLAB_class" in member.attrs:
            array = array.T
        self.arrays[name] = np.squeeze(array) if array.ndim != 1 else array
        for key in ("units", "unit"):
            if unit := _text(member.attrs.get(key, "")):
                self.units[name] = unit


def _is_complex(dtype: np.dtype[Any]) -> bool:
    return dtype.kind == "c" or dtype.names == ("real", "imag")


def _text(value: object) -> str:
    """An attribute as text; "" where it is none."""
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.reshape(-1)[0]
    if isinstance(value, bytes):
        value = value.decode("utf-8", "replace")
    return str(value).strip() if isinstance(value, str) else ""


def read_npz(path: Path, content: bytes) -> Table:
    """numpy archives. Pickled objects are refused."""
    _require_unpacked_size(path, content)
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            arrays, units = plain_arrays({name: archive[name] for name in archive.files})
    except Exception as error:  # numpy raises many kinds of errors on a damaged file
        raise InputError(f"{path}: is not a whole .npz file of plain arrays ({_line(error)})") from error
    return Table(str(path), arrays, units=units)


def read_npy(path: Path, content: bytes) -> Table:
    """One numpy array, called by the name of the file without its ending; each field of a record array by its own.

    Pickled objects are refused.
    """
    try:
        array = np.lib.format.read_array(io.BytesIO(content), allow_pickle=False)
    except Exception as error:  # numpy raises many kinds of errors on a damaged file
        raise InputError(f"{path}: is not a whole .npy file of a plain array ({_line(error)})") from error
    fields = array.dtype.names
    arrays, units = plain_arrays({path.stem: array} if fields is None else {name: array[name] for name in fields})
    return Table(str(path), arrays, units=units)


def read_tdms(path: Path, content: bytes) -> Table:
    """LabVIEW's TDMS; a channel is called by its own name, or ``group/channel`` where several groups have that name.

    Scaled values are read. ``unit_string`` states the unit, ``wf_increment`` the sample time in s, ``wf_start_time``
    and ``wf_start_offset`` the start.
    """
    nptdms = _library("nptdms", path)
    # The library prints by handlers of its own what it skips in a damaged file; the refusals below say it.
    nptdms.log.log_manager.set_level(logging.CRITICAL)
    try:
        file = nptdms.TdmsFile.read(io.BytesIO(content))
        channels = [channel for group in file.groups() for channel in group.channels()]
        values = [np.asarray(channel[:]) for channel in channels]
        whole = not file.file_status.incomplete_final_segment
    except Exception as error:  # the library raises many kinds of errors on a damaged file
        raise InputError(f"{path}: is not a whole TDMS file ({_line(error)})") from error
    if not whole:
        raise InputError(
            f"{path}: is not a whole TDMS file: its last segment is cut off (was the program stopped while it "
            "wrote?), expected a closed file: record again, or save the whole part as a new file"
        )
    plain = [channel.name for channel in channels]
    names = [
        channel.name if plain.count(channel.name) == 1 else f"{channel.group_name}/{channel.name}"
        for channel in channels
    ]
    read = {
        name: array for name, array in zip(names, values, strict=True) if array.dtype.kind in "fiubcMm" and len(array)
    }
    arrays, units = plain_arrays(read)
    clocks: dict[str, tuple[float, float | None]] = {}
    for name, channel in zip(names, channels, strict=True):
        if name not in read:
            continue
        properties = channel.properties
        if unit := _text(properties.get("unit_string", "")):
            units.setdefault(name, unit)
        step = properties.get("wf_increment")
        if isinstance(step, int | float) and np.isfinite(step) and step > 0.0:
            clocks[name] = float(step), _start_s(properties)
    left_out = tuple(f"{name} (no numbers)" for name in names if name not in read)
    return Table(str(path), arrays, units=units, clocks=clocks, left_out=left_out)


def _start_s(properties: Any) -> float | None:
    """Start of a channel, s after 1970, or by the recording's own clock; None where the file does not say."""
    offset, start = properties.get("wf_start_offset", 0.0), properties.get("wf_start_time")
    offset = float(offset) if isinstance(offset, int | float) else 0.0
    if isinstance(start, np.datetime64) and not np.isnat(start):
        return float(start.astype("datetime64[us]").astype(np.int64)) * 1e-6 + offset
    return offset or None


def read_xlsx(path: Path, content: bytes, mapping: ColumnMap) -> Table:
    """Excel workbook: each sheet a table with a row of names, or none. Several sheets: ``sheet!column``.

    Formulas give the values that were stored with them. Charts and empty sheets are passed over.
    """
    openpyxl = _library("openpyxl", path)
    _require_unpacked_size(path, content)
    try:
        book = openpyxl.load_workbook(io.BytesIO(content), read_only=True, data_only=True)
        sheets = {}
        for sheet in book.worksheets:
            # The size that the file announces may be that of the largest sheet there can be.
            sheet.reset_dimensions()
            sheets[sheet.title] = [list(row) for row in sheet.iter_rows(values_only=True)]
        book.close()
    except Exception as error:  # the library raises many kinds of errors on a damaged file
        raise InputError(f"{path}: is not a whole .xlsx file ({_line(error)})") from error
    for rows in sheets.values():
        while rows and all(cell is None for cell in rows[-1]):  # formatted and empty
            rows.pop()
    filled = {title: rows for title, rows in sheets.items() if rows}
    if not filled:
        raise InputError(f"{path}: got a workbook without values, expected one row per sample")
    arrays: dict[str, NDArray[Any]] = {}
    units: dict[str, str] = {}
    notes: list[str] = []
    for title, rows in filled.items():
        prefix = "" if len(filled) == 1 else f"{title}!"
        source = str(path) if len(filled) == 1 else f"{path}, sheet {title}"
        columns, stated, said = _sheet(source, rows, mapping)
        plain, times = plain_arrays(columns)
        arrays |= {prefix + name: array for name, array in plain.items()}
        units |= {prefix + name: unit for name, unit in {**stated, **times}.items()}
        notes += [said] if said else []
    return Table(str(path), arrays, notes=tuple(notes), units=units, positional=len(filled) == 1)


def _sheet(
    source: str, rows: list[list[Any]], mapping: ColumnMap
) -> tuple[dict[str, NDArray[Any]], dict[str, str], str]:
    """The columns of a sheet, the units in the row below their names, and what to tell the user."""
    first = next(k for k, row in enumerate(rows) if any(cell is not None for cell in row))
    if mapping.header not in (None, "none"):
        first = int(str(mapping.header)) - 1
        if first >= len(rows):
            raise InputError(
                f"{source}: header: got row {mapping.header}, beyond the {len(rows)} rows, expected the row of names"
            )
    width = max(len(row) for row in rows[first:])
    rows = [row + [None] * (width - len(row)) for row in rows[first:]]
    while width and all(row[width - 1] is None for row in rows):
        width -= 1
    cells = ["" if cell is None else str(cell).strip() for cell in rows[0][:width]]
    note, units = "", {}
    if has_names(source, cells, mapping, "row", first + 1):
        names, rows = different(cells), rows[1:]
        below = ["" if cell is None else str(cell).strip() for cell in rows[0][:width]] if rows else []
        if units := units_row(names, below):
            note = f"units from row {first + 2}: {', '.join(f'{name} in {unit}' for name, unit in units.items())}"
            rows = rows[1:]
    else:
        names = [str(k) for k in range(1, width + 1)]
        note = "no names of columns in the workbook: they are called by their position, from 1"
    if not rows:
        raise InputError(f"{source}: got names of columns and no samples below, expected one row per sample")
    return {name: _cells([row[k] for row in rows]) for k, name in enumerate(names)}, units, note


def _cells(values: list[Any]) -> NDArray[Any]:
    """A column of cells: numbers with NaN for empty cells, timestamps, or objects where there is a text."""
    import datetime

    filled = [value for value in values if value is not None]
    if filled and all(isinstance(value, datetime.datetime) for value in filled):
        return np.array([np.datetime64("NaT") if value is None else value for value in values], dtype="datetime64[us]")
    if all(isinstance(value, int | float) for value in filled):
        return np.array([np.nan if value is None else value for value in values], dtype=np.float64)
    return np.array([np.nan if value is None else value for value in values], dtype=object)


def _require_unpacked_size(path: Path, content: bytes) -> None:
    """Raise InputError where a zip archive unpacks to more than the memory takes, or is none."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
    except (zipfile.BadZipFile, ValueError, OSError, EOFError, NotImplementedError) as error:
        raise InputError(f"{path}: is not a whole {path.suffix.lower()} file ({_line(error)})") from error
    if size > MAX_BYTES:
        raise InputError(
            f"{path}: got {size / 1e9:.1f} GB unpacked, expected at most {MAX_BYTES / 1e9:g} GB: cut it first"
        )


#: Import name -> name of the distribution.
_LIBRARIES = {"h5py": "h5py", "nptdms": "npTDMS", "openpyxl": "openpyxl"}


def _library(name: str, path: Path) -> Any:
    """The module ``name``. Raises InputError with the command that installs it."""
    import importlib

    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise InputError(
            f"{path}: reading it needs the package {_LIBRARIES[name]}, which is not installed here: "
            f"call make setup again, or python -m pip install {_LIBRARIES[name]}"
        ) from error


def _line(error: Exception) -> str:
    """The first line of an error's message, or its kind."""
    return (str(error).splitlines() or [type(error).__name__])[0][:200]
