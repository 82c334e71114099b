"""``dehyst demo``: identify a simulated stage, run five models on twins of it, change the stage, show the table."""

from __future__ import annotations

import argparse
import json
import logging
import math
import time
from pathlib import Path
from typing import Any

from dehyst.adaptive.errors import InputError
from dehyst.service.cli.options import add_epilog, add_shared, check_seed, progress_printer
from dehyst.service.runtime.stopping import StopSignal

log = logging.getLogger("dehyst.demo")

EPILOG = """\
In real time the demo runs these processes over zenoh on loopback: a simulated stage (five twins of one seed, one for
each model), the service that learns from one of them, a controller that follows its model and evaluates it itself, and
the viewer stream. Each block of 5 ms is commanded one block ahead. If its voltages are late, the stage's clock stands
still for up to 5 s: a busy machine makes the run longer and changes no voltage, and the end of the run says by how
much. --strict keeps real time: 60 ms more are commanded in reserve, and after them the stage holds the last voltage.
--fast runs the same plan in one process, without the viewer's file, and gives the same voltages.
Displacements in µm, errors in percent of the commanded range.

  dehyst demo
  dehyst demo --fast --out out/fast
  dehyst demo --view                 # and watch it in the Rerun viewer
"""
#: Options of earlier releases, with what does the same.
_REMOVED = {
    "ahead": "the controller follows its model; 'dehyst scenarios' asks the axis ahead",
    "mirror": "a fleet learns many axes: serve one by the table [fleet], or call dehyst.adaptive.fleet (docs/fleet.md)",
    "stage": "try the service on it: 'dehyst rehearse --plant STAGE.toml'",
    "side": "the mirror that it was for is gone, see --mirror",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command, with units in the help."""
    add_epilog(parser, EPILOG)
    add = parser.add_argument
    add_shared(parser, out={"default": Path("out/demo"), "help": "folder for the results (%(default)s)"})
    how = parser.add_mutually_exclusive_group()
    how.add_argument("--real-time", action="store_true", help="processes over zenoh, the stage at 1 kHz (default)")
    how.add_argument("--strict", action="store_true", help="the same, and the stage waits for no voltage")
    how.add_argument("--fast", action="store_true", help="one process, as fast as possible, the same numbers")
    add_shared(
        parser,
        duration={"default": 60.0, "help": "length of the run after identification, s (%(default)s)"},
        seed={"default": 20, "help": "seed of the stage's noise and of the reference (%(default)s)"},
    )
    for gone in _REMOVED:
        add(f"--{gone}", nargs="?", const=True, help=argparse.SUPPRESS)
    add("--view", action="store_true", help="also start the Rerun viewer and watch live (needs a display)")
    add("--connect", metavar="URL", help="also stream to a viewer that already runs, rerun+http://HOST:PORT/proxy")
    add_shared(parser, "quiet", json={"help": "print summary.json in place of the table"})


def run(args: argparse.Namespace) -> int:
    """Identify, run, score, draw. Returns 0, or 1 where samples were lost or nothing was measured."""
    from dehyst.lab.demo import session

    if not (math.isfinite(args.duration) and 8.0 <= args.duration <= 86_400.0):
        raise InputError(f"--duration: got {args.duration:g} s, expected 8 to 86400 s; the table needs a settled part")
    check_seed(args.seed)
    for gone, instead in _REMOVED.items():
        if getattr(args, gone) is not None:
            raise InputError(f"--{gone}: removed; {instead}")
    if args.fast and (args.view or args.connect):
        raise InputError("--fast: got --view or --connect with it, expected one of the two: watch a run in real time")
    view = ["--spawn"] if args.view else ["--connect", args.connect] if args.connect else []
    begin = time.perf_counter()
    say = progress_printer(args.quiet, StopSignal(raising=True).look)
    done = session.run(
        args.out, fast=args.fast, duration_s=args.duration, seed=args.seed, view=view, say=say, strict=args.strict,
    )  # fmt: skip
    if args.json:
        print(json.dumps(done.summary))
    else:
        print(_result(done.summary, args.out, time.perf_counter() - begin))
    lost = done.summary["samples"]["sent"] - done.summary["samples"]["received"]
    if lost:
        log.error("%d samples were lost between stage and service", lost)
    return 1 if lost else 0


def _controlled(summary: dict[str, Any]) -> str:
    """What the controller did, in one line."""
    blocks, found = summary["queries"], summary["followed"]
    return (
        f"blocks evaluated by the followed model: {blocks['count']}, median {blocks['p50_us']:.0f} µs, 99 % within "
        f"{blocks['p99_us']:.0f} µs; its last sample was {found['age_p50_ms']:.0f} ms (99 %: "
        f"{found['age_p99_ms']:.0f} ms) old when a block began; {found['late_models']} blocks with an older model than "
        f"planned, {found['lost']} changes lost; "
        f"{found['extrapolated']} voltages from the reserve of an earlier block"
    )


def _result(summary: dict[str, Any], out: Path, seconds: float) -> str:
    from dehyst.lab.demo.raster import told
    from dehyst.lab.demo.result import clock_missed, pace, table

    samples, ticks = summary["samples"], summary["ticks"]
    files = {
        "summary.json": "the numbers above, for programs",
        "tracking.png": "reference and errors over time",
        "loops.png": "what each model leaves of the hysteresis",
        "raster.png": "the error of lines of a raster, with and without repetition",
        "recording/": f"the samples in Parquet; learn from them with: dehyst identify {out / 'recording'} --out m.npz",
        "identification/": "the recording that the models were identified from, and model.npz beside it",
    }
    if summary["mode"] == "real_time":
        files["demo.rrd"] = f"the whole run; open it with: rerun {out / 'demo.rrd'}"
    lines = [
        "",
        table(summary),
        "",
        f"the stage changed at t = {summary['change']['t_s']:g} s: {summary['change']['text']}",
        f"samples: {samples['sent']} sent, {samples['received']} received, {samples['learnt']} learnt from",
        _controlled(summary),
        told(summary["raster"]),
        f"control ticks: {ticks['count']}, {ticks['late']} without their voltage in time",
        *filter(None, [pace(summary), clock_missed(ticks)]),
        f"done in {seconds:.0f} s; in {out}/:",
        *(f"  {name:<16}{what}" for name, what in files.items()),
    ]
    return "\n".join(lines)
