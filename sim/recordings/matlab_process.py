"""The process that reads a MATLAB file of version 4 to 7: the file on stdin, its arrays of numbers on stdout.

scipy's compiled reader can end its process on a damaged file (an invalid data type is used as an index without a
check). In a process of its own this costs one refused file, not the service. `read_mat` starts it by its path, so that
it imports scipy only.

Answer: one line of JSON, then the arrays in numpy's format, one after another, in the order of ``names``. The line is
``{"names": [...], "left_out": [...]}``, or ``{"error": text, "kind": name of the exception}`` without arrays.
"""

from __future__ import annotations

import io
import json
import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Most elements of an array of structures or of cells that are looked into.
MOST_ELEMENTS = 64


def answer(content: bytes) -> tuple[dict[str, Any], list[NDArray[Any]]]:
    """The line for the content of a file, and the arrays behind it."""
    from scipy.io import loadmat

    try:
        variables = loadmat(io.BytesIO(content), squeeze_me=True)
    except Exception as error:  # scipy raises many kinds of errors on a damaged file
        return {"error": (str(error).splitlines() or [""])[0][:200], "kind": type(error).__name__}, []
    arrays: dict[str, NDArray[Any]] = {}
    left_out: list[str] = []
    for name, value in variables.items():
        if not name.startswith("__"):
            _flatten(name, value, arrays, left_out)
    return {"names": list(arrays), "left_out": left_out}, list(arrays.values())


def as_text(name: str) -> str:
    """What to do with a table or an object of MATLAB's, which its own library alone reads."""
    return (
        f": in MATLAB, writetimetable({name}, '{name}.csv') writes a file that opens; of a table writetable, of a "
        f"timeseries timeseries2timetable({name}) first"
    )


def _flatten(name: str, found: Any, into: dict[str, NDArray[Any]], left_out: list[str]) -> None:
    """Add a numeric array, or those in a structure or in cells; texts, tables and objects are left out.

    Of an array of structures each one is called as MATLAB does, ``rec.Y(2).Data``, and each cell ``data{2}``.
    """
    value = np.asarray(found)
    if type(found).__name__ in ("MatlabOpaque", "MatlabFunction"):
        left_out.append(f"{name} (a table or an object{as_text(name)})")
    elif value.dtype.names is not None and value.ndim == 0:
        for field in value.dtype.names:
            _flatten(f"{name}.{field}", value[field].item(), into, left_out)
    elif (value.dtype.names is not None or value.dtype == object) and 0 < value.size <= MOST_ELEMENTS:
        before = len(into), len(left_out)
        for k, element in enumerate(value.reshape(-1), 1):
            _flatten(f"{name}({k})" if value.dtype.names is not None else f"{name}{{{k}}}", element, into, left_out)
        if len(into) == before[0]:  # names, as a rule
            left_out[before[1] :] = [f"{name} (cells)"]
    elif value.dtype.kind in "fiubc":
        into[name] = value
    elif value.dtype.kind in "SU":
        # The name of a channel beside its samples.
        in_array = value.ndim == 0 and ("(" in name or "{" in name)
        left_out.append(f"{name} ({repr(str(value)[:40]) if in_array else 'text'})")
    else:
        left_out.append(f"{name} (no array of numbers)")


def _limit(memory_bytes: int) -> None:
    """Give this process at most so much memory, and let it leave no core file. Without effect on Windows."""
    try:
        import resource
    except ImportError:
        return
    for kind, most in ((resource.RLIMIT_AS, memory_bytes), (resource.RLIMIT_CORE, 0)):
        hard = resource.getrlimit(kind)[1]
        resource.setrlimit(kind, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))


def main() -> None:
    _limit(int(sys.argv[1]))
    line, arrays = answer(sys.stdin.buffer.read())
    out = sys.stdout.buffer
    out.write(json.dumps(line).encode() + b"\n")
    for array in arrays:
        np.lib.format.write_array(out, array, allow_pickle=False)


if __name__ == "__main__":
    main()
