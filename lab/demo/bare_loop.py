"""A bare paced loop as a process: how late this machine is when nothing but the clock is asked for.

``python -m lab.demo.bare_loop DT_S TICKS`` prints one line of JSON at its end.
"""

from __future__ import annotations

import json
import sys
import time


def paced_loop(dt_s: float, ticks: int) -> int:
    """Number of ticks that came late by a full period; time is computed from the tick's number, never summed."""
    late = 0
    start = time.perf_counter()
    for tick in range(1, ticks + 1):
        due = start + tick * dt_s
        rest = due - time.perf_counter()
        if rest > 0.0:
            time.sleep(rest)
        if time.perf_counter() - due > dt_s:
            late += 1
    return late


if __name__ == "__main__":
    try:
        print(json.dumps({"late": paced_loop(float(sys.argv[1]), int(sys.argv[2]))}), flush=True)
    except KeyboardInterrupt:
        sys.exit(130)
