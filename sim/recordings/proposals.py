"""What to propose for a quantity whose column is unknown: the user checks it, nothing here is used unasked."""

from __future__ import annotations

import shlex
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from dehyst.sim.recordings.columns import (
    QUANTITIES,
    TIME_WORDS,
    may_be,
    named_column,
    other_unit_of_name,
    stated_unit,
    unit_of_name,
)
from dehyst.sim.recordings.findings import on_a_line, swapped
from dehyst.sim.recordings.table import Table

#: An array of two dimensions may be columns where one dimension is at most so long and the other so many times longer.
_MOST_COLUMNS, _TIMES_LONGER = 16, 10
_LOOKED_AT: Final = 100_000


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """An array, or with ``index`` a part of one, that may be the samples of a quantity. ``values``: (n,)."""

    name: str
    index: str
    values: NDArray[Any]

    def options(self, quantity: str) -> tuple[str, ...]:
        """The options that choose it for the quantity."""
        column = f"--column {shlex.quote(f'{quantity}={self.name}')}"
        return (column, f"--index {shlex.quote(f'{quantity}={self.index}')}") if self.index else (column,)


def candidates(table: Table) -> list[Candidate]:
    """The arrays of a table that may be samples: numbers, of the most frequent length, and not all the same."""
    found: list[Candidate] = []
    for name, array in table.arrays.items():
        if array.dtype.kind not in "fiub":
            continue
        plain = array.reshape(-1) if array.ndim == 2 and 1 in array.shape else array
        if plain.ndim == 1 and plain.size > 1:
            found.append(Candidate(name, "", plain))
        elif array.ndim == 2 and min(array.shape) <= _MOST_COLUMNS and max(array.shape) >= _TIMES_LONGER:
            by_row = array.shape[0] >= array.shape[1]
            found += [
                Candidate(name, f":,{k}" if by_row else f"{k},:", array[:, k] if by_row else array[k])
                for k in range(min(array.shape))
            ]
    lengths = [len(one.values) for one in found]
    usual = max(sorted(set(lengths), reverse=True), key=lengths.count, default=0)
    return [one for one in found if len(one.values) == usual and _changes(one.values)]


def likely_time(table: Table) -> Candidate | None:
    """The array that is likely the time: by its name, else the only one that rises with every sample.

    A counter of the samples is none, unless it is called a time, nor is a column in a unit of another kind.
    """
    times = QUANTITIES["t"][1]
    units = {name: _unit(table, "t", name) for name in table.arrays}
    found = [
        one
        for one in candidates(table)
        if units[one.name] in times
        or (units[one.name] is None and (not _counts(one.values) or one.name.casefold() in TIME_WORDS))
    ]
    named = named_column("t", [one.name for one in found if not one.index])
    if named is not None:
        return next(one for one in found if one.name == named)
    in_time = [one for one in found if not one.index and units[one.name] in times]
    rising = [one for one in found if _rises(one.values)]
    return next((some[0] for some in (in_time, rising) if len(some) == 1), None)


def likely(
    quantity: str, table: Table, taken: Collection[tuple[str, str]], drive: NDArray[Any] | None = None
) -> Candidate | None:
    """The array to propose for a quantity other than the time; None where none may be it.

    ``taken`` : name and index of those of others. ``drive`` : (n,) the voltage, where it is known; a line of it is no
    reading. Of arrays whose names say nothing, one that lags another is not the voltage.
    """
    units = {name: _unit(table, quantity, name) for name in table.arrays}
    free = [
        one
        for one in candidates(table)
        if (one.name, one.index) not in taken
        and (one.name, "") not in taken
        and may_be(quantity, one.name, units[one.name])
        # What rises with every sample is a clock.
        and not _rises(one.values)
        and not (drive is not None and len(drive) == len(one.values) and on_a_line(drive, one.values))
    ]
    free = [one for one in free if units[one.name] in QUANTITIES[quantity][1]] or free
    name = named_column(quantity, [one.name for one in free])
    if name is not None:
        return next(one for one in free if one.name == name)
    if quantity == "u" and free:
        # Two copies of a sensor do not lag each other.
        first = free[0].values
        other = next((o for o in free if not on_a_line(first[:_LOOKED_AT], o.values[:_LOOKED_AT])), None)
        if other is not None and exchanged(first, other.values):
            return other
    return free[0] if free else None


def exchanged(u: NDArray[Any], y: NDArray[Any]) -> bool:
    """Whether ``u`` (n,) and ``y`` (n,) look exchanged; False where they cannot be compared."""
    return len(u) == len(y) and swapped(u.astype(np.float64), y.astype(np.float64)) != "no"


def _unit(table: Table, quantity: str, name: str) -> str | None:
    """The unit of an array as the file or its name states it; None where neither does."""
    stated = table.units.get(name)
    if stated:
        return stated_unit(stated) or stated
    return unit_of_name(quantity, name) or other_unit_of_name(quantity, name)


def _changes(values: NDArray[Any]) -> bool:
    some = values[:_LOOKED_AT].astype(np.float64)
    some = some[np.isfinite(some)]
    return bool(some.size) and float(np.ptp(some)) > 0.0


def _rises(values: NDArray[Any]) -> bool:
    return bool(np.all(np.diff(values[:_LOOKED_AT].astype(np.float64)) > 0.0))


def _counts(values: NDArray[Any]) -> bool:
    """Whether values (n,) count the samples, from 0 or 1."""
    some = values[:_LOOKED_AT]
    return bool(some[0] in (0, 1)) and bool(np.all(np.diff(some.astype(np.float64)) == 1.0))
