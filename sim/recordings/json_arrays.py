"""JSON of arrays or of records, with units where it has them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from dehyst.adaptive.errors import InputError
from dehyst.sim.recordings.table import Table

#: Words in front of a unit and of a name, in lower case.
_UNIT: Final = ("unit", "units", "egu")
_NAME: Final = ("name", "pvname")
#: Names of a signal's samples.
_VALUES: Final = ("val", "value", "values", "data", "samples")


def read_json(path: Path, content: bytes) -> Table:
    """Arrays of numbers by dotted names (``rec.u``), and lists of objects as columns; ``.jsonl`` has one a line.

    A ``unit``, ``units`` or ``EGU`` beside an array, or in the ``meta`` beside it, states its unit, and a ``name``
    there its name. ``secs`` and ``nanos`` of an archive are one time. null is a missing value. Raises InputError.
    """
    try:
        found = (
            [json.loads(line) for line in content.splitlines() if line.strip()]
            if ".jsonl" in path.suffixes
            else json.loads(content)
        )
        reading = _Json()
        reading.add("", found)
    except (ValueError, TypeError, OverflowError, RecursionError) as error:
        raise InputError(f"{path}: is not whole JSON ({str(error)[:200]}), expected a recording") from error
    return Table(str(path), reading.arrays, units=reading.units, positional=True)


class _Json:
    """Collects the arrays of numbers."""

    def __init__(self) -> None:
        self.arrays: dict[str, NDArray[Any]] = {}
        self.units: dict[str, str] = {}
        self.start_ns: int | None = None

    def add(self, name: str, value: Any) -> None:
        if isinstance(value, dict):
            self._add_object(name, value)
        elif isinstance(value, list) and value and all(isinstance(one, dict) for one in value):
            if any(isinstance(inner, dict | list) for inner in value[0].values()):
                for k, one in enumerate(value, 1):
                    self.add(f"{name}({k})", one)
            else:
                self.add(name, _columns(value))
        elif isinstance(value, list) and len(value) > 1:
            array = _numbers(value)
            if array is not None:
                self.arrays[name or "1"] = array

    def _add_object(self, name: str, value: dict[str, Any]) -> None:
        before = set(self.arrays)
        if "secs" in value and "nanos" in value:
            self._add_time(name, value)
        for key, one in value.items():
            if key not in ("secs", "nanos"):
                self.add(f"{name}.{key}" if name else str(key), one)
        meta = value.get("meta")
        about = {key.casefold(): one for key, one in {**value, **(meta if isinstance(meta, dict) else {})}.items()}
        unit, called = (
            next((about[word] for word in words if isinstance(about.get(word), str)), "") for words in (_UNIT, _NAME)
        )
        new = [one for one in self.arrays if one not in before and one not in self.units]
        signals = new if len(new) == 1 else [one for one in new if one.rpartition(".")[2].casefold() in _VALUES]
        if unit and len(signals) == 1:
            called = called or name or signals[0]
            self.arrays[called] = self.arrays.pop(signals[0])
            self.units[called] = unit

    def _add_time(self, name: str, value: dict[str, Any]) -> None:
        """The time of an archive, s since the first sample of the file; once where channels share it."""
        times_ns = [int(secs) * 10**9 + int(nanos) for secs, nanos in zip(value["secs"], value["nanos"], strict=True)]
        self.start_ns = times_ns[0] if self.start_ns is None else self.start_ns
        t_s = np.array([time_ns - self.start_ns for time_ns in times_ns], dtype=np.float64) * 1e-9
        if not any(unit == "s" and np.array_equal(t_s, self.arrays[one]) for one, unit in self.units.items()):
            self.arrays[f"{name}.time"], self.units[f"{name}.time"] = t_s, "s"


def _columns(records: list[dict[str, Any]]) -> dict[str, Any]:
    """The values of records by key, None where one lacks it."""
    return {key: [record.get(key) for record in records] for key in dict.fromkeys(k for r in records for k in r)}


def _numbers(values: list[Any]) -> NDArray[Any] | None:
    """Numbers as an array, also nested ones, NaN for null; None where there is anything else."""
    try:
        array = np.array(values, dtype=np.float64)
    except (ValueError, TypeError):
        return None
    return None if any(isinstance(one, str | bool) for one in values) else array
