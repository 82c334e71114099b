"""``dehyst bench``: measure the solver beside reference operations.

Needs a checkout of the sources: ``benchmarks/`` is not installed.
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys
from pathlib import Path

from dehyst.adaptive.errors import InputError
from dehyst.service.cli.options import add_epilog, add_shared

EPILOG = """\
Times are medians of single calls in µs, measured in turns with one BLAS thread. Compare ratios across machines, not
times. `ratio` is one update over one dsymv (a symmetric matrix times a vector) of that size.

  dehyst bench --latency                                       # 1 kHz, the learner's own steps
  dehyst bench --latency --rate 5000 --batch 10 --every-sample
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of ``dehyst bench``."""
    add_epilog(parser, EPILOG)
    parser.add_argument(
        "--latency", action="store_true", help="instead: query round trips beside a bare zenoh echo, with learning on"
    )
    parser.add_argument(
        "--rate", type=float, default=1000.0, metavar="HZ", help="with --latency: samples of the stage, 1/s (1000)"
    )
    parser.add_argument("--batch", type=int, default=1, metavar="N", help="with --latency: samples a message (1)")
    parser.add_argument(
        "--every-sample", action="store_true", help="with --latency: filter and window learn every sample"
    )
    add_shared(parser, "quick", json={"help": "print JSON instead of tables"})


def run(args: argparse.Namespace) -> int:
    """Measure and print. Returns 0. Raises InputError where there is no checkout."""
    root = Path(__file__).resolve().parents[2]
    if not (root / "benchmarks" / "solver.py").is_file():
        raise InputError(
            f"bench: no benchmarks/ beside the packages in {root}, expected a checkout of the sources; "
            "clone the repository and call `make bench` there"
        )
    if str(root) not in sys.path:
        sys.path.insert(0, str(root))
    if args.latency:
        return _latency(args)
    benchmarks = importlib.import_module("benchmarks.solver")
    if not args.json:
        print("measuring, this takes " + ("under a minute" if args.quick else "some minutes") + " ...", flush=True)
    report = benchmarks.run(quick=args.quick)
    print(json.dumps(report) if args.json else benchmarks.page(report))
    return 0


def _latency(args: argparse.Namespace) -> int:
    if not 10.0 <= args.rate <= 100_000.0:
        raise InputError(f"--rate: got {args.rate:g}, expected 10 to 100000 samples a second")
    if not 1 <= args.batch <= 4096:
        raise InputError(f"--batch: got {args.batch}, expected 1 to 4096 samples a message")
    benchmarks = importlib.import_module("benchmarks.latency")
    report = benchmarks.latency(args.rate, args.batch, 500 if args.quick else 4000, every_sample=args.every_sample)
    print(json.dumps(report) if args.json else benchmarks.page(report))
    return 0
