"""``dehyst soak``: run all processes under a seeded schedule of faults, check invariants, and judge."""

from __future__ import annotations

import argparse
import json
import math
import re
from pathlib import Path

from dehyst.adaptive.errors import InputError
from dehyst.service.cli.options import add_epilog, add_shared, check_seed, progress_printer

EPILOG = """\
In real time the soak runs these processes on loopback: a router, two services (one a hot standby), a simulated stage, a
controller, a second client that measures, and the viewer's stream.
Times are in s, min, h or d: 90s, 30m, 2h, 3d. Results at the end: soak.json with the verdict, report.md, soak.png, and
plan.json with every fault as it happened. Times are judged as they were measured: leave the machine to the soak.

  dehyst soak --duration 5m
  dehyst soak --duration 40s --faults kill_primary,nan,gap --out out/short
  dehyst soak --duration 2h --seed 7
"""
_UNITS = {"": 1.0, "s": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0, "d": 86400.0}
LEAST_S, MOST_S = 15.0, 90 * 86400.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command, with units in the help."""
    add_epilog(parser, EPILOG)
    add = parser.add_argument
    add_shared(
        parser,
        duration={"type": str, "default": "30m", "metavar": "T", "help": "length: 90s, 30m, 2h, 3d (%(default)s)"},
        seed={"default": 1, "help": "seed of the plan, the reference and the stage's noise (%(default)s)"},
        out={"default": Path("out/soak"), "help": "folder for the results (%(default)s)"},
    )
    add("--fast", action="store_true", help=argparse.SUPPRESS)
    add("--stage", help=argparse.SUPPRESS)
    add("--faults", default="", metavar="A,B", help="only these kinds, or none (all; --list prints them)")
    add("--list", action="store_true", help="list the kinds of faults, and exit")
    add_shared(
        parser,
        "quiet",
        json={"help": "print soak.json in place of the report"},
    )


def run(args: argparse.Namespace) -> int:
    """Run the soak. Returns 0 if every invariant held, 1 if one did not, 130 if interrupted."""
    from dehyst.lab.soak.fault_plan import FAULT_KINDS, make_plan, select_kinds
    from dehyst.service.runtime.stopping import StopSignal

    if args.list:
        for name, kind in FAULT_KINDS.items():
            print(f"{name:<16}{kind.what}")
        return 0
    if args.fast:
        raise InputError("--fast: replaced by `dehyst rehearse`, which runs faults of samples in lockstep")
    if args.stage is not None:
        raise InputError(f"--stage: removed; try the service on it: dehyst rehearse --plant {args.stage}")
    duration_s = seconds(args.duration)
    check_seed(args.seed)
    say = progress_printer(args.quiet)
    kinds = select_kinds([name.strip() for name in args.faults.split(",") if name.strip()])
    stop = StopSignal()
    from dehyst.lab.soak import session as soak
    from dehyst.lab.soak.report import HELD, verdict_line

    done = soak.run(
        args.out,
        make_plan(duration_s, args.seed, kinds),
        stopped=lambda: bool(stop.reason),
        say=say,
    )
    say(f"      {verdict_line(done.found)}")
    print(json.dumps(done.found) if args.json else (args.out / "report.md").read_text(encoding="utf-8"))
    if done.interrupted:
        return 130
    return 0 if done.found["verdict"] == HELD else 1


def seconds(text: str) -> float:
    """``"30m"`` in s. Raises InputError."""
    match = re.fullmatch(r"\s*([0-9.]+)\s*([a-z]*)\s*", text)
    try:
        value = float(match[1]) * _UNITS[match[2]] if match else math.nan
    except (KeyError, ValueError):
        value = math.nan
    if not LEAST_S <= value <= MOST_S:
        raise InputError(
            f"--duration: got {text!r}, expected {LEAST_S:g}s to {MOST_S / 86400:g}d, such as 90s, 30m, 2h, 3d"
        )
    return value
