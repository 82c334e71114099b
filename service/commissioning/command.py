"""``dehyst commission``: identify a stage on live hardware, through its adapter.

THE STAGE MOVES over the stated voltages: make sure that nothing is in its way. FILE.py:NAME is a function without
arguments that opens an adapter (service.adapters.StageAdapter, docs/connect.md); the code in FILE.py is run. Voltages
never leave --u-min to --u-max and never change faster than --slew. Ctrl-C, an error or a fault ramps the stage back to
the voltage at which it was found. The folder gets recording.csv (for dehyst identify), stage.npz and serve.toml (for
dehyst serve) and report.json. Exit status: 0 the target is met, 1 a fault, or what stands in the way, 130 stopped.

  dehyst commission --adapter examples/my_stage.py:open_stage --u-min 0 --u-max 80 --slew 400 --out commissioned
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from typing import Any

from dehyst.service.cli.options import add_shared, check_number, progress_printer
from dehyst.service.cli.python_file import load_object
from dehyst.service.protocol.errors import FieldError
from dehyst.service.protocol.keys import check_name


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command, with units in the help."""
    add = parser.add_argument
    add("--adapter", required=True, metavar="FILE.py:NAME", help="what opens the adapter of the stage")
    add("--u-min", type=float, required=True, metavar="V", help="lowest voltage that may be applied, V")
    add("--u-max", type=float, required=True, metavar="V", help="highest voltage that may be applied, V")
    add("--slew", type=float, required=True, metavar="V/S", help="fastest change of the voltage, V/s")
    add("--gain", type=float, default=math.nan, metavar="UM/V", help="what the stage should move, µm/V, negative where "
        "it moves down, to check sign and unit (by the controller's travel, where it says it)")  # fmt: skip
    add("--target", type=float, default=0.2, metavar="PCT", help="rms error on a held-out stretch at which it is done, "
        "percent of the range (%(default)s)")  # fmt: skip
    add_shared(
        parser, "stage", "axis", "quiet", out={"required": True},
        duration={"default": 180.0, "help": "longest time, s (%(default)g)"},
        json={"help": "print report.json in place of the text"},
    )  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Commission. Returns 0 if the target is met, 130 if stopped by a signal, else 1."""
    from dehyst.service.answers.guard import Limits
    from dehyst.service.commissioning.commission import commission
    from dehyst.service.commissioning.mover import Order
    from dehyst.service.runtime.stopping import StopSignal

    check_name("--stage", args.stage)
    check_name("--axis", args.axis)
    for option, value in (("--target", args.target), ("--duration", args.duration), ("--slew", args.slew)):
        check_number(option, value, low=0, above=True)
    if args.gain == 0.0 or math.isinf(args.gain):
        raise FieldError("--gain", args.gain, "µm/V other than 0")
    order = Order(
        Limits(args.u_min, args.u_max, args.slew), args.gain, args.target, args.duration, args.stage, args.axis
    )
    opener = load_object("--adapter", args.adapter, "examples/my_stage.py:open_stage")
    if not callable(opener):
        raise FieldError("--adapter", args.adapter, "a function without arguments that opens the adapter")
    # Not by KeyboardInterrupt: a vendor's library that catches all exceptions would swallow it.
    stop = StopSignal()
    report = commission(opener, order, args.out, lambda: stop.reason, progress_printer(args.quiet))
    print(json.dumps(report) if args.json else text(report))
    if (fault := report["fault"]) is not None:
        print(f"dehyst commission: {fault['kind']}: {fault['message']}; the stage is {fault['rest']}", file=sys.stderr)
        return 130 if fault["kind"] == "stopped" else 1
    return 1 if report["in_the_way"] else 0


def text(report: dict[str, Any]) -> str:
    """The report for people, with what is known of the stage."""
    lines = []
    if "error_um" in report:
        lag, mode, top = report["lag_s"], report["mode_Hz"], report["swept_to_Hz"]
        lines = [
            f"gain       {report['gain_um_per_V']:.4g} µm/V over {report['range_um']:.4g} µm",
            f"sign, unit {'+' if report['gain_um_per_V'] > 0 else '-'}, µm; checked by {report['checked']}",
            f"hysteresis {100 * report['hysteresis']:.3g} % of the motion",
            f"lag        {'not seen' if lag is None else f'{1e3 * lag:.3g} ms from a voltage to its reading'}",
            f"first mode {f'none up to {top:.3g} Hz' if mode is None else f'{mode:.3g} Hz'}",
            f"noise      {1e3 * report['noise_um']:.3g} nm",
            f"error      {report['error_um']:.3g} µm, {report['error_pct']:.3g} % of the range, of {report['model']} "
            f"on the last stretch, which it had not seen (target {report['target_pct']:g} %)",
            *(f"in the way {line}" for line in report.get("in_the_way", ())),
        ]
    lines.append(f"took       {report['seconds']:g} s")
    return "\n".join(lines)
