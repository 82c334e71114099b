"""Deadlines that a C program misses which follows the model at 10 kHz, and those of the same loop without the model.

``python -m benchmarks.native_loop PROGRAM [--ways plain core+realtime] [--rate 10000] [--seconds 10] [--turns 3]``.
PROGRAM is ``clients/rust/zenoh/c/deadlines.c``, which ``DEHYST_TEST_ZENOH=1 make test-clients`` builds. A service that
learns and a stage that sends at the same rate run throughout, on loopback; the loop with a point and the bare loop take
turns, in each of the ways asked for. A deadline is missed where a turn is done only after the next one was due.

Ways, joined by ``+``: ``plain``; ``receivers``: the threads that receive models run in Linux's idle class;
``realtime``: the loop has a real-time priority (needs the right); ``core``: the loop has the last core and everything
else, the service too, keeps off it; ``warm``: each turn begins 60 us early with ``dehyst_warm``.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any, Final

import psutil

from benchmarks.latency_setup import CONNECT_S, HIGH_UM, LOW_UM, prepare
from benchmarks.sample_feed import AXIS, STAGE
from lab.testbed.identified_stage import Rig
from lab.testbed.processes import Child
from service.client.client import Client

LOOPS: Final = ("bare", "followed")
#: Options of the program, but for ``plain``. ``core`` also keeps the service off the last core, for that way's turns.
WAYS: Final = ("plain", "receivers", "realtime", "core", "warm")
#: Samples a second are sent in messages of this length, s.
_MESSAGE_S: Final = 5e-3
#: Motion of the loop about the centre of the range, of half of it.
_CENTRE_UM: Final = 0.5 * (LOW_UM + HIGH_UM)
_SWING_UM: Final = 0.25 * (HIGH_UM - LOW_UM)


def measured(
    program: Path, rate_hz: float, seconds: float, turns: int, model: str, ways: Sequence[str]
) -> dict[str, Any]:
    """What each turn printed, by way and loop, and the service's rate and state at the end."""
    told: dict[str, Any] = {way: {loop: [] for loop in LOOPS} for way in ways}
    with tempfile.TemporaryDirectory() as folder, Rig(Path(folder)) as rig:
        setup = prepare(rig, Path(folder), rate_hz, max(1, round(_MESSAGE_S * rate_hz)), every_sample=False)
        children = [setup.start_service(), setup.start_feed()]
        with Client.connect(rig.endpoint, STAGE, AXIS, timeout_s=10.0, wait_s=CONNECT_S) as client:
            time.sleep(3.0)
            for turn in range(turns):
                for way in ways:
                    with _last_core_free(children) if "core" in way else nullcontext():
                        for loop in LOOPS if turn % 2 == 0 else reversed(LOOPS):
                            order = [
                                str(program),
                                *(f"--{part}" for part in way.split("+") if part != "plain"),
                                str(seconds),
                                str(rate_hz),
                            ]
                            if loop == "followed":
                                order += [rig.endpoint, STAGE, AXIS, model, str(_CENTRE_UM), str(_SWING_UM)]
                            told[way][loop].append(_run(order, seconds))
                            print(f"{way:20}{loop:10}{told[way][loop][-1]}", file=sys.stderr, flush=True)
            status = client.status()
    keep = ("state", "rate_per_s", "thinning", "snapshot_every")
    return {"rate_hz": rate_hz, "model": model, "ways": told, "service": {name: status[name] for name in keep}}


def _run(order: list[str], seconds: float) -> dict[str, Any]:
    ended = subprocess.run(order, capture_output=True, text=True, timeout=seconds + 60.0, check=False)
    if ended.returncode:
        sys.exit(f"{order[0]} failed: {ended.stdout}{ended.stderr}")
    told: dict[str, Any] = json.loads(ended.stdout)
    return told


@contextmanager
def _last_core_free(children: Sequence[Child]) -> Iterator[None]:
    """Keep all threads of the processes off the last core within the block; this process does not compute."""
    cores = os.sched_getaffinity(0)
    if len(cores) < 2:
        sys.exit("--ways core: got one core, expected two at least")

    def keep_to(wanted: set[int]) -> None:
        for child in children:
            for thread in psutil.Process(child.pid).threads():
                os.sched_setaffinity(thread.id, wanted)

    keep_to(cores - {max(cores)})
    try:
        yield
    finally:
        keep_to(cores)


def page(told: dict[str, Any]) -> str:
    """The figures as a table: sums of turns and missed deadlines, and each percentile's range over the turns."""
    service = told["service"]
    lines = [
        f"{told['rate_hz']:g} Hz, model {told['model']!r}; the service gets {service['rate_per_s']:.0f} samples/s, "
        f"state: {service['state']}, thinning {service['thinning']}",
        f"{'way':20}{'loop':10}{'turns':>9}{'missed':>8}{'share':>8}{'a point, µs: p50':>20}{'p99':>14}{'p99.9':>14}"
        f"{'done, p99.9':>18}",
    ]
    for way, loops in told["ways"].items():
        for loop, parts in loops.items():
            turns, missed = (sum(part[name] for part in parts) for name in ("turns", "missed"))
            spans = [_span([p["point_us"][k] for p in parts]) if loop == "followed" else "" for k in range(3)]
            lines.append(
                f"{way:20}{loop:10}{turns:>9}{missed:>8}{100.0 * missed / turns:>7.2f}%{spans[0]:>20}{spans[1]:>14}"
                f"{spans[2]:>14}{_span([part['done_after_us'][2] for part in parts]):>18}"
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
    parser.add_argument(
        "--ways", nargs="+", default=["plain"], help=f"how the loop is run: {', '.join(WAYS)}, or A+B (plain)"
    )
    parser.add_argument("--json", action="store_true", help="print JSON")
    args = parser.parse_args()
    if not args.program.is_file():
        sys.exit(f"no program at {args.program}: build it with DEHYST_TEST_ZENOH=1 make test-clients")
    for way in args.ways:
        if not set(way.split("+")) <= set(WAYS):
            parser.error(f"--ways: got {way!r}, expected some of {', '.join(WAYS)}, joined by +")
    told = measured(args.program.resolve(), args.rate, args.seconds, args.turns, args.model, args.ways)
    print(json.dumps(told) if args.json else page(told))


if __name__ == "__main__":
    main()
