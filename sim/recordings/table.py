"""The arrays of a file before anything is known of their meaning."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptive.errors import InputError
from adaptive.types import FloatArray


@dataclass(frozen=True, slots=True)
class Table:
    """Arrays by the names that the file gives them.

    Attributes
    ----------
    source : the file, for messages.
    arrays : name -> array of any shape and type.
    dt_s : sample time, s, where the format itself defines one.
    notes : what the reader of the format wants said.
    """

    source: str
    arrays: dict[str, NDArray[Any]]
    dt_s: float | None = None
    notes: tuple[str, ...] = field(default=())

    def describe(self) -> str:
        """Names, with shapes where they are not plain columns."""
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
        """One number. Raises InputError where the array is no single finite number."""
        array = self._array(quantity, name)
        try:
            value = float(np.asarray(array, dtype=np.float64).reshape(-1)[0]) if array.size == 1 else np.nan
        except (TypeError, ValueError):
            value = np.nan
        if not np.isfinite(value):
            raise InputError(f"{self.source}: {name!r} for {quantity}: got no single finite number, expected one")
        return value

    def column(self, quantity: str, name: str, index: str | None) -> FloatArray:
        """One value per sample as float64; arrays of several dimensions need an index such as ``":,0,2"``."""
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
    """Where the first value stands that is no number (data rows count from 1)."""
    for row, value in enumerate(array.tolist(), 1):
        try:
            float(value)
        except (TypeError, ValueError):
            return f"got {value!r} in data row {row}, expected a number"
    return "got values that are no numbers"


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
