"""``dehyst bench``: the solver beside its yardsticks and its peers.

Needs a checkout of the sources: ``benchmarks/`` is not installed.
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys
from pathlib import Path

from adaptive.errors import InputError

EPILOG = """\
Times are medians of single calls in µs, measured in turns with one BLAS thread; compare ratios between
machines, not times. `ratio` is one update over one dsymv (a symmetric matrix times a vector) of that size.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of ``dehyst bench``."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = EPILOG
    parser.add_argument("--json", action="store_true", help="print JSON instead of tables")
    parser.add_argument("--quick", action="store_true", help="fewer repetitions: under a minute, rougher figures")


def run(args: argparse.Namespace) -> int:
    """Measure and print. Raises InputError where the benchmarks are not there."""
    root = Path(__file__).resolve().parents[2]
    if not (root / "benchmarks" / "run.py").is_file():
        raise InputError(
            f"bench: no benchmarks/ beside the packages in {root}, expected a checkout of the sources; "
            "clone the repository and call `make bench` there"
        )
    if str(root) not in sys.path:
        sys.path.insert(0, str(root))
    benchmarks = importlib.import_module("benchmarks.run")
    if not args.json:
        print("measuring, this takes " + ("under a minute" if args.quick else "some minutes") + " ...", flush=True)
    report = benchmarks.run(quick=args.quick)
    print(json.dumps(report) if args.json else benchmarks.page(report))
    return 0
