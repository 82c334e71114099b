"""Priority of processes: background jobs run at low priority, behind the process that answers queries."""

from __future__ import annotations

import contextlib
import os
import time
from pathlib import Path
from typing import Final

#: The lowest priority of Unix (niceness).
LAST: Final = 19
_AUTOGROUP: Final = Path("/proc/self/autogroup")
#: Linux accepts one change of an autogroup in 0.1 s, from all processes together.
_TRIES, _PAUSE_S = 20, 0.11


def step_back(steps: int = LAST) -> None:
    """Increase the niceness of this process by ``steps``, and that of its session if the process leads it.

    With autogroups, which most distributions enable, Linux divides a core between sessions first; niceness counts only
    within a session. A process of the lowest priority in a session of its own would take half a core from the service
    and delay answers by tenths of a second. The session therefore gets a niceness too.
    """
    with contextlib.suppress(OSError, AttributeError):
        os.nice(steps)
        # Do not slow down a session that another process leads, such as a shell.
        if os.getsid(0) != os.getpid():
            return
        for _ in range(_TRIES):
            try:
                _AUTOGROUP.write_text(str(steps), encoding="ascii")
                return
            except BlockingIOError:
                time.sleep(_PAUSE_S)
