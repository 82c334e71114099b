"""What one axis writes to the disk: a service with recorder and checkpoints at 1 kHz, and its ``/proc/PID/io``.

``python -m benchmarks.disk --duration 180`` starts the service as `benchmarks.restart` does, waits until its window is
full, and compares what the system counted, what the status says, and the files. Linux only. On a file system in memory
the system counts nothing.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, Final

from benchmarks.latency_setup import CONNECT_S, prepare
from benchmarks.sample_feed import AXIS, STAGE
from lab.testbed.identified_stage import Rig
from service.client.client import Client

RATE_HZ, BATCH = 1000.0, 5
#: Time until the window of the learner is full, s.
SETTLE_S: Final = 5.0
DAY_S: Final = 86_400.0


def io_bytes(pid: int) -> dict[str, int]:
    """The counters of a process and of its children that have ended: ``write_bytes`` to the disk and others."""
    lines = Path(f"/proc/{pid}/io").read_text(encoding="utf-8").splitlines()
    return {name: int(value) for name, value in (line.split(": ") for line in lines)}


def measure(duration_s: float) -> dict[str, Any]:
    """Bytes written per day and axis: as the system counts, as the status says, and its parts.

    ``disk_GB`` counts what was sent to the disk, whole pages; ``status_GB`` the bytes that the axis wrote; of these
    ``checkpoints_GB``, and ``recording_GB`` for the journal, to which the closed segments are added by ten-minute parts
    only.
    """
    keeps = {"recorder": "rec", "checkpoints": "kept"}
    with tempfile.TemporaryDirectory(dir=".") as folder, Rig(Path(folder)) as rig:
        setup = prepare(rig, Path(folder), RATE_HZ, BATCH, False, keeps)
        service = setup.start_service()
        with Client.connect(setup.endpoint, STAGE, AXIS, wait_s=CONNECT_S, retry_s=CONNECT_S) as client:
            setup.start_feed(0)
            time.sleep(SETTLE_S)
            first, then_s = client.status(), time.monotonic()
            before = io_bytes(service.pid)
            time.sleep(duration_s)
            last, after, now_s = client.status(), io_bytes(service.pid), time.monotonic()
        service.stop()
    per_day = DAY_S / (now_s - then_s) / 1e9
    recorded = last["recorder"]["bytes"] - first["recorder"]["bytes"]
    written = last["disk"]["bytes"] - first["disk"]["bytes"]
    return {
        "duration_s": now_s - then_s,
        "samples_per_s": (last["samples"]["received"] - first["samples"]["received"]) / (now_s - then_s),
        "checkpoints": last["checkpoints"]["written"] - first["checkpoints"]["written"],
        "checkpoint_bytes": last["checkpoints"]["bytes"],
        "disk_GB_per_day": (after["write_bytes"] - before["write_bytes"]) * per_day,
        "status_GB_per_day": written * per_day,
        "checkpoints_GB_per_day": (written - recorded) * per_day,
        "recording_GB_per_day": recorded * per_day,
        "status_bytes_per_s": last["disk"]["bytes_per_s"],
    }


def page(report: dict[str, Any]) -> str:
    """The report as text."""
    return "\n".join(
        [
            f"One axis at {report['samples_per_s']:.0f} samples a second for {report['duration_s']:.0f} s, "
            f"{report['checkpoints']} checkpoints of {report['checkpoint_bytes'] / 1e6:.2f} MB",
            f"sent to the disk, as the system counts: {report['disk_GB_per_day']:.1f} GB a day",
            f"written, as the status says: {report['status_GB_per_day']:.1f} GB a day, of which checkpoints "
            f"{report['checkpoints_GB_per_day']:.1f}, journal {report['recording_GB_per_day']:.1f}; "
            f"{report['status_bytes_per_s']:.0f} bytes a second at the end",
        ]
    )


def main() -> int:
    """``python -m benchmarks.disk``."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.disk", description=__doc__.split("\n")[0])
    parser.add_argument("--duration", type=float, default=180.0, metavar="S", help="how long, s (180)")
    parser.add_argument("--json", action="store_true", help="print JSON instead of text")
    args = parser.parse_args()
    if not 30.0 <= args.duration <= DAY_S:
        parser.error(f"--duration: got {args.duration:g}, expected 30 to {DAY_S:g} s")
    report = measure(args.duration)
    print(json.dumps(report) if args.json else page(report))
    return 0


if __name__ == "__main__":
    sys.exit(main())
