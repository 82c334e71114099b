"""``dehyst reproduce``: the chapter's tables and figures, computed anew."""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

EPILOG = """\
Writes DIR/report.md (the chapter's numbers beside ours), DIR/tables.json, and one PNG a figure in a folder for each
stage. Displacements are in µm, voltages in V, errors in percent of the motion range. Measured data are looked for
in the folder that the environment variable DEHYST_DATA names; where they are missing, that part is left out.

  dehyst reproduce --out out/reproduce
  dehyst reproduce --out out/quick --quick --preset rich --no-pso
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of ``dehyst reproduce``."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = EPILOG
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="folder for the results, made if missing"
    )
    parser.add_argument(
        "--preset", choices=["rich", "bouc_wen", "both"], default="both", help="which simulated stage (both)"
    )
    parser.add_argument("--quick", action="store_true", help="shorter records and 100 epochs: a minute, not several")
    parser.add_argument("--no-pso", action="store_true", help="leave the swarms out; they need torch")
    parser.add_argument("--seed", type=int, default=0, help="of the stages' noise (0)")
    parser.add_argument("--data", type=Path, metavar="DIR", help="folder of measured data (DEHYST_DATA)")
    parser.add_argument("--no-measured", action="store_true", help="leave the measured data out")
    parser.add_argument("--json", action="store_true", help="print tables.json in place of the summary")


def run(args: argparse.Namespace) -> int:
    """Run the study and write it; targets that were missed are said, and are no failure of the program."""
    from threadpoolctl import threadpool_limits

    from lab.reproduce.report import prepare, write_study
    from lab.reproduce.study import StudyConfig, run_study
    from service.protocol.errors import FieldError

    out = prepare(args.out)
    if args.data is not None and not args.data.is_dir():
        raise FieldError("--data", str(args.data), "a folder with the measured data")
    begin = time.perf_counter()

    def say(text: str) -> None:
        print(f"{time.perf_counter() - begin:6.1f} s  {text}", file=sys.stderr, flush=True)

    config = StudyConfig(
        presets=("rich", "bouc_wen") if args.preset == "both" else (args.preset,),
        quick=args.quick,
        pso=not args.no_pso,
        epochs=100 if args.quick else 1500,
        seed=args.seed,
        data=args.data,
        measured=not args.no_measured,
    )
    # Times are those of one thread: two make a solve of 1 ms stall for much longer now and then.
    with threadpool_limits(limits=1):
        numbers = write_study(run_study(config, say), out, say)
    print(json.dumps(numbers, ensure_ascii=False) if args.json else summary(numbers, out))
    return 0


def summary(numbers: dict[str, Any], out: Path) -> str:
    """What was reached, for people."""
    width = max(len(target["what"]) for target in numbers["targets"])
    lines = [f"{'':{width}}   {'at most':>9} {'found':>9}"]
    for target in numbers["targets"]:
        mark = "" if target["met"] else "   missed"
        lines.append(f"{target['what']:{width}}   {target['limit']:9.3g} {target['found']:9.3g}{mark}")
    lines.append(f"report: {out / 'report.md'}; numbers: {out / 'tables.json'}; {numbers['seconds']:.0f} s")
    return "\n".join(lines)
