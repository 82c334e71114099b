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
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.npy_sizes import check_npy, check_npz
from dehyst.sim.recordings.columns import ColumnMap
from dehyst.sim.recordings.delimited_text import read_lines
from dehyst.sim.recordings.matlab_process import MOST_ELEMENTS, as_text
from dehyst.sim.recordings.table import MAX_BYTES, Table, plain_arrays, seconds

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
    return _arrow_table(path, table)


def read_feather(path: Path, content: bytes) -> Table:
    """Feather and other files of Arrow's; times as in Parquet."""
    import pyarrow as pa

    try:
        table = pa.ipc.open_file(io.BytesIO(content)).read_all()
    except (pa.ArrowException, OSError) as error:
        raise InputError(f"{path}: is not a whole Feather file ({_line(error)})") from error
    return _arrow_table(path, table)


def _from_arrow(column: Any) -> tuple[NDArray[Any], bool]:
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


def _arrow_table(path: Path, table: Any) -> Table:
    columns = {name: _from_arrow(table.column(name)) for name in table.column_names}
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
            if isinstance(group.get(key, getlink=True), self.h5py.HardLink):
                self._add_member(group, name, group[key], depth)
            else:
                self.left_out.append(f"{name} (a link)")

    def _add_member(self, group: Any, name: str, member: Any, depth: int) -> None:
        self.members += 1
        if self.members > _MOST_MEMBERS or depth > _DEEPEST:
            raise InputError(
                f"{self.path}: got more than {_MOST_MEMBERS} members or {_DEEPEST} levels of groups, expected a "
                "recording: copy the arrays into a file of their own"
            )
        if isinstance(member, self.h5py.Group):
            self.add(member, f"{name}.", depth + 1)
        else:
            self._add_dataset(group, name, member, depth)

    def _add_dataset(self, group: Any, name: str, member: Any, depth: int) -> None:
        if isinstance(member, self.h5py.Dataset) and self.h5py.check_ref_dtype(member.dtype) is self.h5py.Reference:
            self._add_elements(group, name, member, depth)
        elif reason := self._unreadable(name, member):
            self.left_out.append(f"{name} ({reason})")
        elif member.dtype.names is not None and not _is_complex(member.dtype):
            self._add_fields(name, member)
        else:
            self._add_array(name, member)

    def _add_elements(self, group: Any, name: str, member: Any, depth: int) -> None:
        """MATLAB's cells (``data{2}``), or one field of an array of structures (``rec.Y(2).Data``)."""
        cells = _text(member.attrs.get("MATLAB_class", "")) == "cell"
        kind = "cells" if cells else "a struct array"
        in_struct = _text(group.attrs.get("MATLAB_class", "")) == "struct"
        if not (cells or in_struct) or "MATLAB_empty" in member.attrs or (member.size or 0) > MOST_ELEMENTS:
            self.left_out.append(f"{name} ({kind if cells or in_struct else 'no numbers'})")
            return
        before = len(self.arrays), len(self.left_out)
        base, _, field = name.rpartition(".")
        for k, reference in enumerate(np.asarray(member[()]).reshape(-1), 1):
            if reference:
                element = f"{name}{{{k}}}" if cells else f"{base}({k}).{field}"
                self._add_member(group, element, member.file[reference], depth + 1)
        if len(self.arrays) == before[0]:  # names, as a rule
            self.left_out[before[1] :] = [f"{name} ({kind})"]

    def _add_fields(self, name: str, member: Any) -> None:
        """The columns of a table, as h5py and pandas write records."""
        self._reserve(name, member)
        table = np.asarray(member[()])
        for field in table.dtype.names or ():
            if table.dtype[field].kind in "fiub":
                self.arrays[f"{name}.{field}"] = np.ascontiguousarray(table[field])
            else:
                self.left_out.append(f"{name}.{field} (no numbers)")

    def _unreadable(self, name: str, member: Any) -> str:
        """Why a member holds no array of numbers; "" where it does."""
        if not isinstance(member, self.h5py.Dataset):
            return "no array"
        if member.is_virtual or member.external:
            return "its values are in another file"
        matlab = _text(member.attrs.get("MATLAB_class", ""))
        if "MATLAB_empty" in member.attrs:
            return "empty"
        if matlab and matlab not in ("double", "single", "logical") and not matlab.startswith(("int", "uint")):
            return {"char": "text", "cell": "cells", "struct": "a struct array"}.get(
                matlab, f"a {matlab}{as_text(name)}"
            )
        if member.dtype.kind in "fiub" or member.dtype.names is not None:
            return ""
        return "no numbers"

    def _reserve(self, name: str, member: Any) -> None:
        # Compressed data may unpack to a thousand times the file.
        self.bytes += member.size * member.dtype.itemsize
        if self.bytes > MAX_BYTES:
            raise InputError(
                f"{self.path}: its arrays take more than {MAX_BYTES / 1e9:g} GB unpacked ({name} has shape "
                f"{member.shape}), expected at most that: copy the recording into a file of its own"
            )

    def _add_array(self, name: str, member: Any) -> None:
        self._reserve(name, member)
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


_PICKLED = "a pickled Python object, which is never loaded"


def read_npz(path: Path, content: bytes) -> Table:
    """numpy archives. Pickled objects are left out."""
    read: dict[str, NDArray[Any]] = {}
    left_out: list[str] = []
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as members:
            check_npz(members, MAX_BYTES)
        with np.lib.npyio.NpzFile(io.BytesIO(content), allow_pickle=False) as archive:
            for name in archive.files:
                try:
                    read[name] = archive[name]
                except ValueError as error:
                    if "Object arrays" not in str(error):
                        raise
                    left_out.append(f"{name} ({_PICKLED})")
            arrays, units = plain_arrays(read)
    except Exception as error:  # numpy raises many kinds of errors on a damaged file
        raise InputError(f"{path}: is not a whole .npz file of plain arrays ({_line(error)})") from error
    if left_out and not arrays:
        raise InputError(f"{path}: holds {_PICKLED}, expected plain arrays: save each as one")
    return Table(str(path), arrays, units=units, left_out=tuple(left_out))


def read_npy(path: Path, content: bytes) -> Table:
    """One numpy array, called by the name of the file without its ending; each field of a record array by its own.

    Pickled objects are refused.
    """
    try:
        check_npy(io.BytesIO(content), len(content))
        array = np.lib.format.read_array(io.BytesIO(content), allow_pickle=False)
    except Exception as error:  # numpy raises many kinds of errors on a damaged file
        if "Object arrays" in str(error):
            raise InputError(
                f"{path}: holds {_PICKLED}, expected a plain array: of a dictionary of arrays, "
                "numpy.savez('recording.npz', **data) makes a file that opens"
            ) from error
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
    """Excel workbook: each sheet is read as text with a line for each row. Several sheets: ``sheet!column``.

    Formulas give the values that were stored with them. Charts and empty sheets are passed over, sheets of remarks left
    out.
    """
    openpyxl = _library("openpyxl", path)
    _require_unpacked_size(path, content)
    sheets: dict[str, list[str]] = {}
    try:
        book = openpyxl.load_workbook(io.BytesIO(content), read_only=True, data_only=True)
        for sheet in book.worksheets:
            # The size that the file announces may be that of the largest sheet there can be.
            sheet.reset_dimensions()
            rows = [[_cell(value) for value in row] for row in sheet.iter_rows(values_only=True)]
            while rows and not any(rows[-1]):  # formatted and empty
                rows.pop()
            width = max(map(len, rows), default=0)
            # In one column an empty line would be no row.
            empty = "nan" if width == 1 else ""
            rows = [row + [""] * (width - len(row)) for row in rows]
            sheets[sheet.title] = ["\t".join(cell or empty for cell in row) + "\n" for row in rows]
        book.close()
    except Exception as error:  # the library raises many kinds of errors on a damaged file
        raise InputError(f"{path}: is not a whole .xlsx file ({_line(error)})") from error
    several, tabs = len(sheets) > 1, replace(mapping, delimiter="\t")
    tables: dict[str, Table] = {}
    refused: dict[str, InputError] = {}
    for title, lines in sheets.items():
        if any(line.strip() for line in lines):
            try:
                tables[title] = read_lines(f"{path}, sheet {title}" if several else str(path), lines, tabs)
            except InputError as error:  # a sheet of remarks, as a rule
                refused[title] = error
    if not tables:
        nothing = InputError(f"{path}: got a workbook without values, expected one row per sample")
        raise next(iter(refused.values()), nothing)
    arrays: dict[str, NDArray[Any]] = {}
    units: dict[str, str] = {}
    for title, table in tables.items():
        prefix = f"{title}!" if len(tables) > 1 else ""
        arrays |= {prefix + name: array for name, array in table.arrays.items()}
        units |= {prefix + name: unit for name, unit in table.units.items()}
    notes = tuple(note for table in tables.values() for note in table.notes)
    left_out = tuple(f"sheet {title} ({error})" for title, error in refused.items())
    return Table(str(path), arrays, notes=notes, units=units, positional=len(tables) == 1, left_out=left_out)


def _cell(value: Any) -> str:
    """A cell of a workbook as text: numbers with all their digits, times as other text has them."""
    import datetime

    if isinstance(value, bool | int | float):
        return repr(float(value)) if isinstance(value, float) else str(int(value))
    if isinstance(value, datetime.timedelta):
        return f"{value.total_seconds()} sec"
    return "" if value is None else " ".join(str(value).split())


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
