"""Exported C as a function: compiled strictly, loaded, and run over a whole motion."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from dehyst.adaptive.types import FloatArray
from dehyst.service.export.c_source import CSource, c_source
from dehyst.service.export.exporting import Frozen

STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic")
needs_a_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler (cc) on this machine")
Run = Callable[[FloatArray, FloatArray, FloatArray], tuple[FloatArray, FloatArray]]

_LOOP = """
#include "NAME.h"
void run(int n, const double *y, const double *v, const double *a, double *u, double *flags);
void run(int n, const double *y, const double *v, const double *a, double *u, double *flags)
{
    NAME_state axis;
    NAME_init(&axis, (NAME_real)y[0]);
    for (int i = 0; i < n; i++) {
        u[i] = (double)NAME_step(&axis, (NAME_real)y[i], (NAME_real)v[i], (NAME_real)a[i]);
        flags[i] = axis.flags;
    }
}
"""


def compiled(frozen: Frozen, *flags: str) -> tuple[Run, CSource]:
    """(function of y, v, a that gives voltages and flags, (n,) each; the C) of ``frozen``."""
    source = c_source(frozen.model, frozen.limits, frozen.name, frozen.origin, 0.0)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for ending in (".h", ".c"):
            (folder / f"{frozen.name}{ending}").write_text(source.texts[ending])
        (folder / "loop.c").write_text(_LOOP.replace("NAME", frozen.name))
        made = [f"{frozen.name}.c", "loop.c", "-o", "it.so", "-lm"]
        subprocess.run(["cc", *STRICT, "-O2", "-shared", "-fPIC", *flags, *made], cwd=folder, check=True)
        library = ctypes.CDLL(str(folder / "it.so"))

    def run(y: FloatArray, v: FloatArray, a: FloatArray) -> tuple[FloatArray, FloatArray]:
        u, found = np.empty(y.size), np.empty(y.size)
        arrays = [np.ascontiguousarray(x, dtype=np.float64) for x in (y, v, a)]
        library.run(y.size, *(x.ctypes.data_as(ctypes.POINTER(ctypes.c_double)) for x in (*arrays, u, found)))
        return u, found

    return run, source
