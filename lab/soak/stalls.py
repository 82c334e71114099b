"""What the threads of the services did while no query was answered: evidence for `queries_answered`.

A silence has two kinds of causes. If a thread of the service waited for another one (a lock, the disk), the service is
the cause. If the thread was ready and got no processor, the machine is the cause. The kernel counts both for each
thread (``/proc/PID/task/TID/schedstat``: time on a processor, time ready and waiting for one). `StallWatch` keeps the
counts of the last second, and when the prober reports a silence it writes what has happened since, the state of each
thread and the kernel function in which it waits, and lets the services write the Python stacks of all their threads
(``logs/stacks-PID.txt``, see `lab.testbed.shifted_clock`), as soon as its main thread gets the interpreter lock. Linux
only.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from lab.testbed.shifted_clock import stacks_file

#: Signal on which a service writes its stacks.
DUMP: Final = signal.SIGUSR2
#: Pause between two looks at the prober, s; between two of the counts; least between two that are written; most of
#: them in a run.
_LOOK_S: Final = 0.03
_COUNT_S: Final = 1.0
_APART_S: Final = 5.0
_MOST: Final = 100
#: A thread waited for the machine if it was ready without a processor for so much of the silence, and of the time in
#: which it was counted.
_MACHINE_SHARE: Final = 0.5
_READY_SHARE: Final = 0.3


@dataclass(frozen=True, slots=True)
class ThreadTimes:
    """A thread: name, state letter (R ready or running, S waits, D waits for the disk), kernel function in which it
    waits, and its time on a processor and ready for one, s."""

    name: str
    state: str
    waits_in: str
    ran_s: float
    ready_s: float


def threads_of(pid: int) -> dict[int, ThreadTimes]:
    """The threads of a process by id; those that end meanwhile are left out."""
    found: dict[int, ThreadTimes] = {}
    with contextlib.suppress(OSError):
        for task in Path(f"/proc/{pid}/task").iterdir():
            with contextlib.suppress(OSError, ValueError, IndexError):
                text = (task / "stat").read_text()
                name, rest = text[text.index("(") + 1 : text.rindex(")")], text[text.rindex(")") + 2 :]
                ran_ns, ready_ns = (task / "schedstat").read_text().split()[:2]
                waits_in = ""
                with contextlib.suppress(OSError):
                    waits_in = (task / "wchan").read_text().strip("0\n")
                found[int(task.name)] = ThreadTimes(name, rest[0], waits_in, int(ran_ns) / 1e9, int(ready_ns) / 1e9)
    return found


def since(before: Mapping[int, ThreadTimes], now: Mapping[int, ThreadTimes]) -> list[dict[str, Any]]:
    """The threads that ran or were ready since ``before``, those that waited for a processor longest first."""
    rows = []
    for number, thread in now.items():
        was = before.get(number)
        ran_s = thread.ran_s - (was.ran_s if was else 0.0)
        ready_s = thread.ready_s - (was.ready_s if was else 0.0)
        if ran_s > 1e-4 or ready_s > 1e-4 or thread.state != "S":
            row = {"thread": thread.name, "id": number, "state": thread.state, "waits_in": thread.waits_in}
            rows.append(row | {"ran_ms": round(1e3 * ran_s, 1), "ready_ms": round(1e3 * ready_s, 1)})
    return sorted(rows, key=lambda row: -float(row["ready_ms"]))


def cause(silent_s: float, over_s: float, threads: list[dict[str, Any]]) -> str:
    """Whose a silence is: "machine" if a thread was ready without a processor for half as long as the silence, and for
    a good share of the time ``over_s`` in which it was counted; else "service"."""
    longest_s = max((1e-3 * float(row["ready_ms"]) for row in threads), default=0.0)
    return "machine" if longest_s >= max(_MACHINE_SHARE * silent_s, _READY_SHARE * over_s) else "service"


class StallWatch:
    """Watches for silences; use as a context manager. It writes one JSON object a line to ``stalls.jsonl``.

    Parameters
    ----------
    folder : for the file. silence : returns the silence that the prober has reported since the last call, s; 0 for
    none. processes : by name, the id of each service and of what lies between it and the prober. now_s : time of the
    run.
    """

    def __init__(
        self,
        folder: Path,
        silence: Callable[[], float],
        processes: Callable[[], Mapping[str, int]],
        now_s: Callable[[], float],
    ) -> None:
        self._folder, self._path = folder, folder / "stalls.jsonl"
        self._silence, self._processes, self._now_s = silence, processes, now_s
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="soak-stalls", daemon=True)
        self._written = 0
        self.machine = self.service = 0

    def __enter__(self) -> StallWatch:
        if sys.platform == "linux":
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join()

    def note(self) -> str:
        """A sentence on what was found; "" for nothing."""
        if not self._written:
            return ""
        return (
            f"in {self._written} silences of more than 0.1 s the threads were looked at: in {self.machine} one was "
            f"ready for most of it and got no processor, in {self.service} none was; see logs/stalls.jsonl"
        )

    def _run(self) -> None:
        before: dict[str, dict[int, ThreadTimes]] = {}
        counted_s = written_s = -_APART_S
        while not self._closing.wait(_LOOK_S):
            silent_s = self._silence()
            now = time.monotonic()
            if silent_s and now - written_s >= _APART_S and self._written < _MOST:
                written_s = now
                self._write(silent_s, now - counted_s, before)
            if now - counted_s >= _COUNT_S:
                counted_s = now
                before = {name: threads_of(pid) for name, pid in self._processes().items()}

    def _write(self, silent_s: float, over_s: float, before: Mapping[str, Mapping[int, ThreadTimes]]) -> None:
        processes = self._processes()
        for pid in processes.values():
            # Who writes no stacks, or not yet, would be ended by the signal.
            with contextlib.suppress(OSError):
                if stacks_file(self._folder, pid).stat().st_size:
                    os.kill(pid, DUMP)
        found = {name: since(before.get(name, {}), threads_of(pid)) for name, pid in processes.items()}
        why = cause(silent_s, over_s, [row for rows in found.values() for row in rows])
        self.machine += why == "machine"
        self.service += why == "service"
        self._written += 1
        line = {"t_s": round(self._now_s(), 2), "silent_s": silent_s, "counted_over_s": round(over_s, 2), "cause": why}
        with contextlib.suppress(OSError), self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps({**line, "load": os.getloadavg()[0], "processes": found}) + "\n")
