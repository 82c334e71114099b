"""Freed memory goes back to the system."""

from __future__ import annotations

import gc
import platform
import subprocess
import sys

import pytest

from dehyst.service.runtime.memory import starting

glibc = pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library is left as it is")

_CODE = """
import sys, threading
import numpy as np, psutil
from dehyst.service.runtime.memory import give_back, keep_little
little = sys.argv[1] == "little"
if little:
    assert keep_little()
def work():
    kept = []
    for k in range(300):
        large = [np.ones(40_000) for _ in range(8)]
        kept.append(np.ones(3000))
        del large
    return kept
threads = [threading.Thread(target=work) for _ in range(8)]
for t in threads: t.start()
for t in threads: t.join()
if little:
    assert give_back()
print(psutil.Process().memory_info().rss)
"""


def resident(how: str) -> int:
    run = subprocess.run([sys.executable, "-c", _CODE, how], capture_output=True, text=True, timeout=120, check=True)
    return int(run.stdout)


@glibc
def test_many_threads_and_large_blocks_leave_nothing_behind() -> None:
    assert resident("little") < resident("as it is")


def test_what_is_there_after_the_start_is_never_looked_through_again() -> None:
    try:
        with starting() as started:
            assert not gc.isenabled()
            started()
            assert gc.isenabled()
            assert gc.get_freeze_count() > 10_000
            assert len(gc.get_objects(2)) < 0.01 * gc.get_freeze_count()
    finally:
        gc.unfreeze()
