"""One reader per file format, each giving a :class:`~sim.recordings.table.Table`.

CSV and other delimited text with a header line, Parquet, MATLAB ``.mat`` (up to version 7), ``.npz``; the array
files of piezo controllers are in :mod:`sim.recordings.gcs`.
"""

from __future__ import annotations

import io
import re
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptive.errors import InputError
from sim.recordings.columns import ColumnMap
from sim.recordings.table import Table


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
        # Without a pool of threads: a process that ends right after it was begun is aborted by its runtime.
        table = parquet.ParquetFile(io.BytesIO(content), pre_buffer=False).read(use_threads=False)
    except (pa.ArrowInvalid, OSError) as error:
        raise InputError(f"{path}: is not a whole Parquet file ({error})") from error
    return Table(str(path), {name: _from_arrow(table.column(name)) for name in table.column_names})


def read_mat(path: Path, content: bytes) -> Table:
    """MATLAB files of version 4 to 7; fields of structures by dotted names (``rec.u``)."""
    from scipy.io import loadmat

    try:
        variables = loadmat(io.BytesIO(content), squeeze_me=True)
    except NotImplementedError as error:
        raise InputError(
            f"{path}: is a MATLAB 7.3 file (HDF5), expected version 7 or older: in MATLAB, load it and call "
            f"save('{path.stem}_v7.mat', '-v7')"
        ) from error
    except Exception as error:  # scipy raises what it meets first in a damaged file
        raise InputError(f"{path}: is not a whole .mat file ({error})") from error
    arrays: dict[str, NDArray[Any]] = {}
    for name, value in variables.items():
        if not name.startswith("__"):
            _flatten(name, np.asarray(value), arrays)
    return Table(str(path), arrays)


def _flatten(name: str, value: NDArray[Any], into: dict[str, NDArray[Any]]) -> None:
    """Numeric arrays as they are, structures field by field; what is neither (tables, objects) is left out."""
    if value.dtype.names is not None and value.ndim == 0:
        for field in value.dtype.names:
            _flatten(f"{name}.{field}", np.asarray(value[field].item()), into)
    elif value.dtype.kind in "fiub":
        into[name] = value


def read_npz(path: Path, content: bytes) -> Table:
    """numpy archives; pickled objects are refused."""
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            return Table(str(path), {name: archive[name] for name in archive.files})
    except (ValueError, OSError, EOFError, KeyError, zipfile.BadZipFile, AttributeError, TypeError) as error:
        raise InputError(f"{path}: is not a whole .npz file of plain arrays ({error})") from error


def decode(path: Path, content: bytes) -> str:
    """Text of a file in UTF-8 (with or without mark), UTF-16 with mark, or Latin-1 (old controllers' µ and °)."""
    if content[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return content.decode("utf-16")
    if b"\x00" in content[:4096]:
        raise InputError(f"{path}: is no text, expected .csv, .parquet, .mat, .npz or a controller's array file")
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
