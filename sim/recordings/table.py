"""The arrays of a file by the file's own names, before a mapping says what they mean."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray

#: Largest content of a file when unpacked, bytes; more does not fit into the memory of common machines.
MAX_BYTES = 2_000_000_000
#: Names in a message; more would hide what it says.
MOST_NAMES = 40


@dataclass(frozen=True, slots=True)
class Table:
    """The arrays of a file by the names that the file gives them, before their meaning is known.

    Attributes
    ----------
    source : the file, for messages.
    arrays : name -> array of any shape and type.
    notes : remarks of the reader, for people.
    units : name -> unit, where the file states it apart from the name.
    clocks : name -> (sample time, start), s, where the file has them for each array; None for an unknown start.
    positional : whether the arrays are columns in an order, so that a position from 1 may stand for a name.
    left_out : names of what the file holds and the reader cannot read, with the reason.
    """

    source: str
    arrays: dict[str, NDArray[Any]]
    notes: tuple[str, ...] = field(default=())
    units: dict[str, str] = field(default_factory=dict)
    clocks: dict[str, tuple[float, float | None]] = field(default_factory=dict)
    positional: bool = False
    left_out: tuple[str, ...] = ()

    def describe(self) -> str:
        """The names, with the shapes of arrays that are not plain columns, and what was left out."""
        parts = [n if a.ndim == 1 else f"{n}{list(a.shape) if a.ndim else ''}" for n, a in self.arrays.items()]
        text = _shortened(parts) or "nothing"
        return f"{text} (left out: {_shortened(self.left_out)})" if self.left_out else text

    def named(self, quantity: str, name: str) -> str:
        """The name of the array that ``name`` means: itself, or the column at this position.

        Several neighbours (``"2:6"``) have no name of their own and are returned as they are. Raises InputError where
        the file has no such array.
        """
        if name in self.arrays:
            return name
        if self.positional and (match := re.fullmatch(r"([1-9]\d*)(?::([1-9]\d*))?", name)):
            first, last = int(match.group(1)), int(match.group(2) or match.group(1))
            if match.group(2) is None and first <= len(self.arrays):
                return list(self.arrays)[first - 1]
            if first < last <= len(self.arrays):
                return name
            raise InputError(
                f"{self.source}: column {name!r} for {quantity}: got a position outside the file's "
                f"{len(self.arrays)} columns ({self.describe()}), expected 1 to {len(self.arrays)}"
            )
        way = "NAME, or its position from 1" if self.positional else "NAME"
        raise InputError(
            f"{self.source}: got no column {name!r} for {quantity}; the file holds {self.describe()}: "
            f"choose with --column {quantity}={way}"
        )

    def array(self, quantity: str, name: str) -> NDArray[Any]:
        """The array of a name or position; several columns (``"2:6"``) as (n, k). Raises InputError."""
        name = self.named(quantity, name)
        if name in self.arrays:
            return self.arrays[name]
        first, last = (int(end) for end in name.split(":"))
        return np.column_stack(list(self.arrays.values())[first - 1 : last])

    def scalar(self, quantity: str, name: str) -> float:
        """A single number. Raises InputError where the array is anything else."""
        array = self.array(quantity, name)
        try:
            value = float(np.asarray(array, dtype=np.float64).reshape(-1)[0]) if array.size == 1 else np.nan
        except (TypeError, ValueError):
            value = np.nan
        if not np.isfinite(value):
            raise InputError(f"{self.source}: {name!r} for {quantity}: expected a single finite number")
        return value

    def column(self, quantity: str, name: str, index: str | None) -> tuple[FloatArray, str]:
        """(n,) float64, and what was done to its shape ("" for nothing).

        An array of several dimensions needs an index such as ``":,0,2"``; a ``*`` in it puts the entries of that
        dimension one after another. Raises InputError.
        """
        array, done = self.array(quantity, name), ""
        if index is not None:
            where, periods_first = _parse_index(self.source, quantity, name, array.shape, index)
            array = array[where]
            if periods_first is not None:
                array = array if periods_first else array.T
                done = f"{quantity}: {array.shape[0]} periods of {array.shape[1]} samples put one after another"
                array = array.reshape(-1)
        elif array.ndim == 2 and 1 in array.shape:
            array = array.reshape(-1)
        if array.ndim != 1:
            example = ",".join([":"] + ["0"] * (array.ndim - 1)) if array.ndim else "..."
            periods = ",".join(["0"] * (array.ndim - 2) + ["*", ":"])
            raise InputError(
                f"{self.source}: {name!r} for {quantity} has shape {array.shape}, expected one value per sample: "
                f"choose with --index {quantity}={example} (one ':' for the samples), or with '*' put the periods of "
                f"the drive one after another: --index {quantity}={periods} if the last dimension is the samples"
            )
        return self._numbers(quantity, name, array), done

    def _numbers(self, quantity: str, name: str, array: NDArray[Any]) -> FloatArray:
        if array.dtype.kind == "c":
            raise InputError(
                f"{self.source}: column {name!r} for {quantity}: got complex numbers (a spectrum?), expected samples "
                "over time"
            )
        try:
            return np.ascontiguousarray(array, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise InputError(f"{self.source}: column {name!r} for {quantity}: {_first_text(array)}") from error


def seconds(stamps: NDArray[Any]) -> FloatArray:
    """Timestamps (n,) as seconds since the first, durations (n,) as seconds; NaN where there is none."""
    if stamps.dtype.kind == "M":
        known = stamps[~np.isnat(stamps)]
        stamps = stamps - known[0] if len(known) else stamps - stamps
    # Nanoseconds as integers: a difference of float64 seconds since 1970 is good to 0.2 µs only.
    whole = stamps.astype("timedelta64[ns]")
    return np.where(np.isnat(whole), np.nan, whole.astype(np.int64) * 1e-9)


def plain_arrays(arrays: dict[str, NDArray[Any]]) -> tuple[dict[str, NDArray[Any]], dict[str, str]]:
    """``arrays`` with timestamps and durations in seconds, and the units of these: name -> ``s``."""
    times = [name for name, array in arrays.items() if array.dtype.kind in "Mm"]
    plain = {name: seconds(array) if name in times else array for name, array in arrays.items()}
    return plain, dict.fromkeys(times, "s")


def _shortened(names: list[str] | tuple[str, ...]) -> str:
    more = len(names) - MOST_NAMES
    return ", ".join(names[:MOST_NAMES]) + (f" and {more} more" if more > 0 else "")


def _first_text(array: NDArray[Any]) -> str:
    """The first value that is not a number, with its data row (counted from 1)."""
    for row, value in enumerate(array.tolist(), 1):
        try:
            float(value)
        except (TypeError, ValueError):
            comma = isinstance(value, str) and re.fullmatch(r"\s*[-+]?\d+,\d+(?:[eE][-+]?\d+)?\s*", value)
            hint = "; if its comma is the decimal sign: --decimal ," if comma else ""
            return f"got {value!r} in data row {row}, expected a number{hint}"
    return "got values that are not numbers"


def _parse_index(
    source: str, quantity: str, name: str, shape: tuple[int, ...], text: str
) -> tuple[tuple[slice | int, ...], bool | None]:
    """The index, and whether the dimension to put one after another comes first; None where there is none."""
    fail = InputError(
        f"{source}: index of {quantity}: got {text!r} for {name!r} of shape {shape}, expected {len(shape)} entries, "
        "one ':' for the samples, '*' for periods to put one after another, and whole numbers within the shape for "
        "the rest"
    )
    entries = [entry.strip() for entry in text.split(",")]
    if len(entries) != len(shape) or entries.count(":") != 1 or entries.count("*") > 1:
        raise fail
    chosen: list[slice | int] = []
    for entry, size in zip(entries, shape, strict=True):
        if entry in (":", "*"):
            chosen.append(slice(None))
        elif entry.isdecimal() and int(entry) < size:
            chosen.append(int(entry))
        else:
            raise fail
    return tuple(chosen), entries.index("*") < entries.index(":") if "*" in entries else None
