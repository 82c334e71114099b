"""What to propose for a quantity whose column is unknown: the user checks it, nothing here is used unasked."""

from __future__ import annotations

import shlex
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sim.recordings.columns import (
    QUANTITIES,
    TIME_WORDS,
    other_unit_of_name,
    proposed_column,
    stated_unit,
    unit_of_name,
)
from sim.recordings.table import Table

#: An array of two dimensions may be columns where one dimension is at most so long and the other so many times longer.
_MOST_COLUMNS, _TIMES_LONGER = 16, 10
#: Rates of samples that are likely, Hz: by them a unit of time is proposed.
_LIKELY_RATES_HZ: Final = (5.0, 5e6)
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

    A counter of the samples is none, unless it is called a time.
    """
    found = [
        one
        for one in candidates(table)
        if not _counts(one.values)
        or one.name.casefold() in TIME_WORDS
        or _unit(table, "t", one.name) in QUANTITIES["t"][1]
    ]
    named = proposed_column("t", [one.name for one in found if not one.index], ())
    if named is not None:
        return next(one for one in found if one.name == named)
    in_time = [one for one in found if not one.index and _unit(table, "t", one.name) in QUANTITIES["t"][1]]
    rising = [one for one in found if bool(np.all(np.diff(one.values[:_LOOKED_AT].astype(np.float64)) > 0.0))]
    return next((some[0] for some in (in_time, rising) if len(some) == 1), None)


def likely(quantity: str, table: Table, taken: Collection[tuple[str, str]]) -> Candidate | None:
    """The array to propose for a quantity other than the time; ``taken``: name and index of those of others."""
    time = likely_time(table)
    free = [one for one in candidates(table) if (one.name, one.index) not in taken and (one.name, "") not in taken]
    clock = (time.name, time.index) if time else None
    free = [one for one in free if (one.name, one.index) != clock and not _counts(one.values)]
    if not free:
        return None
    factors = QUANTITIES[quantity][1]
    units = {one.name: _unit(table, quantity, one.name) for one in free}
    fitting = [one for one in free if units[one.name] in factors]
    if not fitting and quantity == "u":  # a displacement drives nothing
        fitting = [one for one in free if units[one.name] is None]
    free = fitting or free
    name = proposed_column(quantity, [one.name for one in free], ())
    return next((one for one in free if one.name == name), free[0])


def likely_time_unit(values: NDArray[Any]) -> str:
    """The unit that gives a time (n,) a likely rate: ``s``, ``ms``, ``us`` or ``ns``."""
    if values.ndim != 1 or values.dtype.kind not in "fiu":
        return "s"
    steps = np.diff(values[:_LOOKED_AT].astype(np.float64))
    steps = steps[steps > 0.0]
    least, most = _LIKELY_RATES_HZ
    for unit in ("s", "ms", "us", "ns"):
        if len(steps) and least <= 1.0 / (float(np.median(steps)) * QUANTITIES["t"][1][unit]) <= most:
            return unit
    return "s"


def _unit(table: Table, quantity: str, name: str) -> str | None:
    """The unit of an array as the file or its name states it; None where neither does."""
    stated = table.units.get(name)
    if stated:
        return stated_unit(stated) or stated
    return unit_of_name(quantity, name) or other_unit_of_name(quantity, name)


def in_another_file(quantity: str, table: Table) -> tuple[str, ...]:
    """The options for a quantity that no array of ``table`` can be: instruments write a file for each channel."""
    file, time = f"--file {quantity}=FILE", likely_time(table)
    others = [one.name for one in candidates(table) if time is None or one.name != time.name]
    if quantity != "y" or len(others) != 1:
        return (file,)
    unit = _unit(table, "u", others[0])
    # The sensor's file is like that of the voltage: with a unit in volts, or without any.
    if unit is None:
        return (file, "--unit y=um")
    return (file, "--scale y=FACTOR") if unit in QUANTITIES["u"][1] else (file,)


def _changes(values: NDArray[Any]) -> bool:
    some = values[:_LOOKED_AT].astype(np.float64)
    some = some[np.isfinite(some)]
    return bool(some.size) and float(np.ptp(some)) > 0.0


def _counts(values: NDArray[Any]) -> bool:
    """Whether values (n,) count the samples, from 0 or 1."""
    some = values[:_LOOKED_AT]
    return bool(some[0] in (0, 1)) and bool(np.all(np.diff(some.astype(np.float64)) == 1.0))
