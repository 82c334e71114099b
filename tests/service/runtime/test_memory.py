"""Freed memory goes back to the system."""

from __future__ import annotations

import platform
import subprocess
import sys

import pytest

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
