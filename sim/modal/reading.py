"""Periodic recordings from files: several drives and outputs, realisations and periods, by the same column mapping."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray
from dehyst.sim.modal.periods import PeriodicRecord, cut_into_periods
from dehyst.sim.recordings import ColumnMap
from dehyst.sim.recordings.columns import default_column, factor_and_unit
from dehyst.sim.recordings.reader import read_table, sample_times
from dehyst.sim.recordings.table import Table

#: The quantities that are drives, and those that are outputs.
DRIVES = ("u", "u2", "u3")
OUTPUTS = ("y", "y2")


def read_periodic(
    path: Path | str, mapping: ColumnMap | None = None, period: int | None = None, skip: int = 0
) -> PeriodicRecord:
    """Read the drives and outputs of a file.

    A quantity is one or several columns, ``u=CH1,CH2,CH3``, or an array of the shape (samples, channels[,
    realisations[, periods]]). ``period``: its length in samples, where the file does not hold the periods as a fourth
    axis; ``skip``: periods at the start that are not yet steady.

    Raises InputError naming the file, what was found, what was expected, and the option that corrects it.
    """
    path, mapping = Path(path), mapping or ColumnMap()
    if period is not None and period < 1:
        raise InputError(f"period: got {period} samples, expected 1 or more")
    if skip < 0:
        raise InputError(f"skip periods: got {skip}, expected 0 or more")
    if mapping.files or mapping.repeat:
        named = ", ".join((*mapping.files, *mapping.repeat))
        raise InputError(f"{path}: file, repeat: got {named}, expected none: give all channels and periods in one file")
    table = read_table(path, mapping)
    u_V, y_um = _channels(table, DRIVES, mapping), _channels(table, OUTPUTS, mapping)
    _, dt_s = sample_times(table, mapping, len(u_V))
    if mapping.sensor_late:
        raise InputError(
            f"{path}: sensor_late: got {mapping.sensor_late}, expected 0: a delay is part of the modal model"
        )
    return PeriodicRecord(path.name, _periods(path, u_V, period, skip), _periods(path, y_um, period, skip), dt_s)


def _channels(table: Table, quantities: tuple[str, ...], mapping: ColumnMap) -> FloatArray:
    """(samples, channels, realisations, periods or 1) of all channels of the quantities, in V or µm."""
    parts = []
    for quantity in quantities:
        named = mapping.columns.get(quantity) or default_column(table.source, quantity, list(table.arrays))
        if named is None:
            continue
        names = [named] if named in table.arrays else [name.strip() for name in named.split(",")]
        for name in names:
            parts.append(_one(table, quantity, table.named(quantity, name), mapping))
    if not parts:
        raise InputError(
            f"{table.source}: got columns {table.describe()}, expected one or more for {quantities[0]}: add --column "
            f"{quantities[0]}=NAME or {quantities[0]}=NAME1,NAME2"
        )
    shapes = {(part.shape[0], *part.shape[2:]) for part in parts}
    if len(shapes) > 1:
        raise InputError(
            f"{table.source}: {quantities[0]}: got channels of the shapes {sorted(shapes)}, expected the same samples, "
            "realisations and periods for all"
        )
    return np.concatenate(parts, axis=1)


def _one(table: Table, quantity: str, name: str, mapping: ColumnMap) -> FloatArray:
    factor, _ = factor_and_unit(table.source, quantity, name, mapping, table.units.get(name))
    index = mapping.index.get(quantity)
    array = table.arrays.get(name)
    if index is not None or array is None or array.ndim < 2:
        values, _ = table.column(quantity, name, index)
    elif array.ndim > 4 or array.dtype.kind not in "fiu":
        raise InputError(
            f"{table.source}: {name!r} for {quantity} has shape {array.shape} and type {array.dtype}, expected numbers "
            "of the shape (samples, channels, realisations, periods)"
        )
    else:
        values = array.astype(np.float64)
    while values.ndim < 4:
        values = values[..., None]
    return np.asarray(values * factor, dtype=np.float64)


def _periods(path: Path, values: FloatArray, period: int | None, skip: int) -> FloatArray:
    """(samples a period, channels, realisations, periods)."""
    samples, _, realisations, periods = values.shape
    if period is None and periods == 1:
        raise InputError(
            f"{path}: period: got none, expected the length of a period in samples: add --period N; "
            f"N = {samples} takes the whole recording as one period"
        )
    if period is None or period == samples:
        if skip >= periods:
            raise InputError(f"{path}: skip periods: got {skip} of {periods}, expected fewer")
        return values[..., skip:]
    if periods > 1:
        raise InputError(f"{path}: period: got {period}, expected {samples}, the length of the array's first axis")
    return np.concatenate([cut_into_periods(values[:, :, r, 0], period, skip) for r in range(realisations)], axis=2)
