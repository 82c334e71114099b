"""Deadlines that a C program misses which follows the model at 10 kHz, and those of the same loop without the model.

``python -m benchmarks.native_loop PROGRAM [--rate 10000] [--seconds 10] [--turns 3] [--model auto] [--json]``. PROGRAM
is ``clients/rust/zenoh/c/deadlines.c``, which ``DEHYST_TEST_ZENOH=1 make test-clients`` builds. A service that learns
and a stage that sends at the same rate run throughout, on loopback; the loop with a point and the bare loop take turns.
A deadline is missed where a turn is done only after the next one was due.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, Final

from benchmarks.latency_setup import CONNECT_S, HIGH_UM, LOW_UM, prepare
from benchmarks.sample_feed import AXIS, STAGE
from lab.testbed.identified_stage import Rig
from service.client.client import Client

WAYS: Final = ("bare", "followed")
#: Samples a second are sent in messages of this length, s.
_MESSAGE_S: Final = 5e-3
#: Motion of the loop about the centre of the range, of half of it.
_CENTRE_UM: Final = 0.5 * (LOW_UM + HIGH_UM)
_SWING_UM: Final = 0.25 * (HIGH_UM - LOW_UM)


def measured(program: Path, rate_hz: float, seconds: float, turns: int, model: str) -> dict[str, Any]:
    """What each turn printed, by way, and the service's rate and state at the end."""
    told: dict[str, Any] = {way: [] for way in WAYS}
    with tempfile.TemporaryDirectory() as folder, Rig(Path(folder)) as rig:
        setup = prepare(rig, Path(folder), rate_hz, max(1, round(_MESSAGE_S * rate_hz)), every_sample=False)
        setup.start_service()
        setup.start_feed()
        with Client.connect(rig.endpoint, STAGE, AXIS, timeout_s=10.0, wait_s=CONNECT_S) as client:
            time.sleep(3.0)
            for turn in range(turns):
                for way in WAYS if turn % 2 == 0 else reversed(WAYS):
                    order = [str(program), str(seconds), str(rate_hz)]
                    if way == "followed":
                        order += [rig.endpoint, STAGE, AXIS, model, str(_CENTRE_UM), str(_SWING_UM)]
                    ended = subprocess.run(order, capture_output=True, text=True, timeout=seconds + 60.0, check=False)
                    if ended.returncode:
                        sys.exit(f"{program} failed: {ended.stdout}{ended.stderr}")
                    told[way].append(json.loads(ended.stdout))
                    print(f"{way:10}{ended.stdout.strip()}", file=sys.stderr, flush=True)
            status = client.status()
    keep = ("state", "rate_per_s", "thinning", "snapshot_every")
    return told | {"rate_hz": rate_hz, "model": model, "service": {name: status[name] for name in keep}}


def page(told: dict[str, Any]) -> str:
    """The figures as a table: sums of turns and missed deadlines, and each percentile's range over the turns."""
    service = told["service"]
    lines = [
        f"{told['rate_hz']:g} Hz, model {told['model']!r}; the service gets {service['rate_per_s']:.0f} samples/s, "
        f"state: {service['state']}",
        f"{'loop':10}{'turns':>9}{'missed':>8}{'a point, µs: p50':>20}{'p99':>14}{'p99.9':>14}{'done, p99.9':>18}",
    ]
    for way in WAYS:
        parts = told[way]
        turns, missed = (sum(part[name] for part in parts) for name in ("turns", "missed"))
        spans = [_span([part["point_us"][k] for part in parts]) for k in range(3)] if way == "followed" else [""] * 3
        lines.append(
            f"{way:10}{turns:>9}{missed:>8}{spans[0]:>20}{spans[1]:>14}{spans[2]:>14}"
            f"{_span([part['done_after_us'][2] for part in parts]):>18}"
        )
    return "\n".join(lines)


def _span(values: list[float]) -> str:
    return f"{min(values):.1f} to {max(values):.1f}"


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("program", type=Path, help="the program built from clients/rust/zenoh/c/deadlines.c")
    parser.add_argument("--rate", type=float, default=10_000.0, help="of the loop and of the samples, Hz (%(default)s)")
    parser.add_argument("--seconds", type=float, default=10.0, help="length of each turn, s (%(default)s)")
    parser.add_argument("--turns", type=int, default=3, help="turns of both loops (%(default)s)")
    parser.add_argument("--model", default="auto", help="lssvm_adaptive or auto (%(default)s)")
    parser.add_argument("--json", action="store_true", help="print JSON")
    args = parser.parse_args()
    if not args.program.is_file():
        sys.exit(f"no program at {args.program}: build it with DEHYST_TEST_ZENOH=1 make test-clients")
    told = measured(args.program.resolve(), args.rate, args.seconds, args.turns, args.model)
    print(json.dumps(told) if args.json else page(told))


if __name__ == "__main__":
    main()
