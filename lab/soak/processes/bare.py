"""A bare paced loop beside a soak, as a process: how late this machine lets anybody run who asks for nothing but that.

``python -m lab.soak.processes.bare`` prints a line of JSON every second: the time, and the most that a tick came
late, s.
"""

from __future__ import annotations

import json
import sys
import time

from service.runtime.stopping import StopSignal

#: Distance of the ticks, s.
STEP_S = 2e-3


def main() -> int:
    """Entry of the process. Returns its exit status."""
    stop = StopSignal()
    print("ready", flush=True)
    due = second = time.monotonic()
    worst_s = 0.0
    while not stop.reason:
        due += STEP_S
        rest = due - time.monotonic()
        if rest > 0.0:
            time.sleep(rest)
        now = time.monotonic()
        worst_s = max(worst_s, now - due)
        # What was missed is not made up for: each wait is judged by itself.
        due = max(due, now - STEP_S)
        if now - second >= 1.0:
            second = now
            print(json.dumps({"t_s": round(now, 3), "late_s": round(worst_s, 5)}), flush=True)
            worst_s = 0.0
    return 0


if __name__ == "__main__":
    sys.exit(main())
