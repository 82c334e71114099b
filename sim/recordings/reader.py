"""Reads a file into a recording with the project's columns and units."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptive.errors import InputError
from adaptive.types import FloatArray
from sim.recordings.columns import KELVIN_AT_0_C, QUANTITIES, ColumnMap, default_column, factor_and_unit
from sim.recordings.formats import Table, is_gcs, read_gcs, read_mat, read_npz, read_parquet, read_text
from sim.recordings.recording import Recording

#: Largest file, bytes; larger ones do not fit into the memory of common machines.
MAX_BYTES = 2_000_000_000


def read(path: Path | str, mapping: ColumnMap | None = None) -> Recording:
    """Read a file, or a folder of Parquet segments in the order of their names.

    The ending selects the format: ``.parquet``, ``.mat``, ``.npz``. Any other file is text: a controller's array file
    where it begins as one, otherwise delimited text with a header line.

    Raises InputError naming the file, what was found, what was expected, and the option that corrects it.
    """
    path, mapping = Path(path), mapping or ColumnMap()
    table, digest = read_table(path, mapping)
    return _recording(table, mapping, str(path), digest)


def read_table(path: Path, mapping: ColumnMap) -> tuple[Table, str]:
    """The arrays of a file or a folder of segments, and its SHA-256, before their meaning is known. As `read`."""
    if path.is_dir():
        files = sorted(path.glob("*.parquet"))
        if not files:
            raise InputError(f"{path}: got a folder without .parquet files, expected a recording")
    else:
        files = [path]
    contents = [_bytes(file) for file in files]
    digest = hashlib.sha256()
    for content in contents:
        digest.update(content)
    tables = [_table(file, content, mapping) for file, content in zip(files, contents, strict=True)]
    return tables[0] if len(tables) == 1 else _joined(path, tables), digest.hexdigest()


def _bytes(path: Path) -> bytes:
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise InputError(f"{path}: got {size / 1e9:.1f} GB, expected at most {MAX_BYTES / 1e9:g} GB: cut it first")
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); expected a recording") from error
    if not content:
        raise InputError(f"{path}: got an empty file, expected a recording")
    return content


def _table(path: Path, content: bytes, mapping: ColumnMap) -> Table:
    ending = path.suffix.lower()
    if ending in (".parquet", ".pq"):
        return read_parquet(path, content)
    if ending == ".mat":
        return read_mat(path, content)
    if ending == ".npz":
        return read_npz(path, content)
    if is_gcs(content):
        return read_gcs(path, content, mapping)
    return read_text(path, content, mapping)


def _joined(path: Path, tables: list[Table]) -> Table:
    names = list(tables[0].arrays)
    for table in tables[1:]:
        if set(table.arrays) != set(names):
            raise InputError(
                f"{table.source}: got columns {table.describe()}, expected {', '.join(names)} as before it"
            )
    arrays = {name: np.concatenate([table.arrays[name] for table in tables]) for name in names}
    return Table(str(path), arrays, notes=(f"{len(tables)} segments",))


def _column(table: Table, quantity: str, mapping: ColumnMap, *, needed: bool) -> FloatArray | None:
    name = mapping.columns.get(quantity) or default_column(table.source, quantity, list(table.arrays))
    if name is None:
        if not needed:
            return None
        canonical, factors = QUANTITIES[quantity]
        raise InputError(
            f"{table.source}: got columns {table.describe()}, expected {canonical}: add --column {quantity}=NAME "
            f"and, unless the name ends in one, its unit (--unit {quantity}=...: {', '.join(factors)})"
        )
    factor, unit = factor_and_unit(table.source, quantity, name, mapping)
    values = table.column(quantity, name, mapping.index.get(quantity))
    if unit == "K":
        return values - KELVIN_AT_0_C
    return values if factor == 1.0 else values * factor


def _scalar(table: Table, quantity: str, mapping: ColumnMap) -> float | None:
    """Sample time or rate stored in the file; only where the user names it or it has its canonical name."""
    name = mapping.columns.get(quantity)
    if name is None:
        canonical = QUANTITIES[quantity][0]
        if canonical not in table.arrays:
            return None
        name = canonical
    factor, _ = factor_and_unit(table.source, quantity, name, mapping)
    return table.scalar(quantity, name) * factor


def _recording(table: Table, mapping: ColumnMap, source: str, sha256: str) -> Recording:
    u_V = _column(table, "u", mapping, needed=True)
    y_um = _column(table, "y", mapping, needed=True)
    assert u_V is not None
    assert y_um is not None
    t_s, dt_s = sample_times(table, mapping, len(u_V))
    columns: dict[str, NDArray[Any] | None] = {"t_s": t_s, "u_V": u_V, "y_um": y_um}
    for quantity in ("u2", "y2", "u3", "monitor", "temperature"):
        columns[QUANTITIES[quantity][0]] = _column(table, quantity, mapping, needed=False)
    if "seq" in table.arrays and table.arrays["seq"].dtype.kind in "iu":
        columns["seq"] = table.arrays["seq"].astype(np.int64)
    if "reason" in table.arrays:
        columns["reason"] = table.arrays["reason"].astype(np.str_)
    for name, values in columns.items():
        if values is not None and len(values) != len(t_s):
            raise InputError(f"{source}: {name}: got {len(values)} samples, expected {len(t_s)} as t_s")
    notes = list(table.notes)
    if mapping.sensor_late:
        columns = _sensor_moved(source, columns, mapping.sensor_late, len(t_s))
        notes.append(f"sensor's column moved back by {mapping.sensor_late} samples (sensor_late)")
    return Recording(dt_s=dt_s, source=source, sha256=sha256, notes=tuple(notes), **columns)  # type: ignore[arg-type]


def _sensor_moved(
    source: str, columns: dict[str, NDArray[Any] | None], late: int, n: int
) -> dict[str, NDArray[Any] | None]:
    if late >= n:
        raise InputError(f"{source}: sensor_late: got {late} samples, expected fewer than the recording's {n}")
    sensors = ("y_um", "y2_um")
    return {
        name: None if values is None else (values[late:] if name in sensors else values[:-late])
        for name, values in columns.items()
    }


def sample_times(table: Table, mapping: ColumnMap, n: int) -> tuple[FloatArray, float]:
    """Time of each sample and the nominal sample time, from a column, an option, or the format."""
    t_s = _column(table, "t", mapping, needed=False)
    rate_hz = _scalar(table, "rate", mapping)
    stated = mapping.dt_s or _scalar(table, "dt", mapping) or (1.0 / rate_hz if rate_hz else None)
    if t_s is not None and mapping.dt_s is None:
        return t_s, nominal_dt(table.source, t_s)
    dt_s = stated or table.dt_s
    if dt_s is None:
        raise InputError(
            f"{table.source}: got columns {table.describe()} and no time, expected a column t_s: add --column t=NAME "
            "--unit t=..., or the sample time as --dt-s SECONDS, or --column rate=NAME where the file holds a rate"
        )
    if not (0.0 < dt_s < 1e6):
        raise InputError(f"{table.source}: sample time: got {dt_s:g} s, expected a positive number")
    return np.arange(n, dtype=np.float64) * dt_s, float(dt_s)


def nominal_dt(source: str, t_s: FloatArray) -> float:
    """Sample time from a time column (n,), s: the mean of the steps near the median. Raises InputError."""
    steps = np.diff(t_s)
    steps = steps[np.isfinite(steps) & (steps > 0.0)]
    if not len(steps):
        raise InputError(f"{source}: t_s: got a time that never increases, expected increasing times in s")
    rough = float(np.median(steps))
    # Gaps and doubled stamps would bias the mean.
    good = steps[np.abs(steps - rough) < 0.5 * rough]
    # Nine digits exceed the accuracy of any clock and remove round-off of the time column.
    return float(f"{np.mean(good) if len(good) else rough:.9g}")
