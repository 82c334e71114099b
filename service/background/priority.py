"""Who goes first on a machine with few cores: work in the background steps back behind whoever answers."""

from __future__ import annotations

import contextlib
import os
import time
from pathlib import Path
from typing import Final

#: The lowest priority there is.
LAST: Final = 19
_AUTOGROUP: Final = Path("/proc/self/autogroup")
#: The system takes one such wish in a tenth of a second, from all processes together.
_TRIES, _PAUSE_S = 20, 0.11


def step_back(steps: int = LAST) -> None:
    """Make this process nicer by so many steps, and its session too where it is its own.

    Linux shares a processor between sessions first, with autogroups as most distributions have them, and looks at what
    is nice within a session only: the lowest priority in a session of its own takes half a core from a service that
    has another session, and held its answers up for tenths of a second. A session has a niceness of its own for that.
    """
    with contextlib.suppress(OSError, AttributeError):
        os.nice(steps)
        # A session that was somebody else's, such as a shell's, is not this process' to slow down.
        if os.getsid(0) != os.getpid():
            return
        for _ in range(_TRIES):
            try:
                _AUTOGROUP.write_text(str(steps), encoding="ascii")
                return
            except BlockingIOError:
                time.sleep(_PAUSE_S)
