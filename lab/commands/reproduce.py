"""``dehyst reproduce``: compute the chapter's tables."""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

from dehyst.service.cli.options import add_epilog, add_shared, progress_printer

EPILOG = """\
Writes DIR/report.md (the chapter's numbers beside ours), DIR/tables.json, and some figures in a folder for each
stage. Displacements are in µm, voltages in V, errors in percent of the motion range. Measured data come from the
folder in the environment variable DEHYST_DATA; where they are missing, that part is left out.

  dehyst reproduce --out out/reproduce
  dehyst reproduce --out out/quick --quick --preset rich --no-pso
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of ``dehyst reproduce``."""
    add_epilog(parser, EPILOG)
    add_shared(parser, out={"required": True, "help": "folder for the results"})
    parser.add_argument(
        "--preset", choices=["rich", "bouc_wen", "both"], default="both", help="which simulated stage (both)"
    )
    parser.add_argument("--no-pso", action="store_true", help="leave out the swarms, which need torch")
    parser.add_argument("--data", type=Path, metavar="DIR", help="folder of measured data (DEHYST_DATA)")
    parser.add_argument("--no-measured", action="store_true", help="leave out the measured data")
    add_shared(
        parser,
        "quiet",
        quick={"help": "shorter records and 100 epochs: one minute instead of several"},
        seed={"help": "seed of the stages' noise (%(default)s)"},
        json={"help": "print tables.json in place of the summary"},
    )


def run(args: argparse.Namespace) -> int:
    """Run the study and write it. Returns 0, also where a target is missed: the summary says so."""
    from threadpoolctl import threadpool_limits

    from dehyst.lab.reproduce.measured import StudyConfig, run_study
    from dehyst.lab.reproduce.report import write_study
    from dehyst.service.protocol.errors import FieldError
    from dehyst.service.storage.output import clear_output

    clear_output(args.out)
    if args.data is not None and not args.data.is_dir():
        raise FieldError("--data", str(args.data), "a folder with the measured data")
    begin = time.perf_counter()

    show = progress_printer(args.quiet)

    def say(text: str) -> None:
        show(f"{time.perf_counter() - begin:6.1f} s  {text}")

    config = StudyConfig(
        presets=("rich", "bouc_wen") if args.preset == "both" else (args.preset,),
        quick=args.quick,
        pso=not args.no_pso,
        epochs=100 if args.quick else 1500,
        seed=args.seed,
        data=args.data,
        measured=not args.no_measured,
    )
    # One BLAS thread: with two, a solve of 1 ms now and then takes much longer.
    with threadpool_limits(limits=1):
        numbers = write_study(run_study(config, say), args.out, say)
    print(json.dumps(numbers, ensure_ascii=False) if args.json else summary(numbers, args.out))
    return 0


def summary(numbers: dict[str, Any], out: Path) -> str:
    """The targets and what was reached, as text."""
    width = max(len(target["what"]) for target in numbers["targets"])
    lines = [f"{'':{width}}   {'at most':>9} {'found':>9}"]
    for target in numbers["targets"]:
        mark = "" if target["met"] else "   missed"
        lines.append(f"{target['what']:{width}}   {target['limit']:9.3g} {target['found']:9.3g}{mark}")
    lines.append(f"report: {out / 'report.md'}; numbers: {out / 'tables.json'}; {numbers['seconds']:.0f} s")
    return "\n".join(lines)
