"""``dehyst diagnose``: name the effects in a recording that the simulation lacks, fit them, measure each gain.

Writes DIR/report.md with its pictures, DIR/report.json (schema 2, see docs/diagnosis.md), and DIR/stage.toml, the
extended stage that `dehyst stage --file` and `dehyst rehearse --plant` run.
Displacements are in µm, voltages in V, times in s. DATA may be the folder into which `dehyst serve` records.

  dehyst diagnose recording.csv --out out/diagnosis
  dehyst diagnose train.csv --test test.csv --stage mystage.toml --out out/diagnosis
  dehyst diagnose scope.csv --column y=CH2 --scale y=10 --column u=CH1 --unit u=V --dt-s 1e-3 --out out/diagnosis
  dehyst diagnose drive.npy --unit u=V --repeat u --file y=readings.npy --unit y=um --index 'y=*,:' --dt-s 1e-4 \\
      --out out/diagnosis
  dehyst diagnose train.csv --nominal linear --range 0:10 --out out/diagnosis --json

'dehyst stage --examples DIR' makes a folder with the files that these examples name.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

from dehyst.service.cli.options import add_shared, progress_printer
from dehyst.service.identification.recording_options import add_mapping_arguments, describe, load
from dehyst.service.protocol.errors import FieldError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of ``dehyst diagnose``."""
    parser.add_argument("data", type=Path, metavar="DATA", help="the recording: a file, or a folder of segments")
    add_shared(parser, "range", out={"required": True, "help": "folder for the report"})
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--stage", type=Path, metavar="STAGE.toml", help="the simulation to compare with: a stage file")
    what.add_argument(
        "--nominal",
        default="bouc_wen",
        metavar="NAME",
        help="or by name: bouc_wen, the chapter's stage (default), or linear, one mode of second order",
    )
    add_shared(
        parser,
        "test-range",
        test={"help": "another recording of the stage, same columns: nothing is fitted, the verdict is its own"},
        seed={"help": "seed of the null distribution (%(default)s)"},
    )
    add_shared(parser, "quiet", json={"help": "print report.json in place of the summary"})
    add_mapping_arguments(parser, test=True)


def run(args: argparse.Namespace) -> int:
    """Read, check, diagnose, write. Returns 0."""
    from dehyst.service.reports.diagnosis import Source, write_report
    from dehyst.service.storage.output import check_folder
    from dehyst.sim.diagnosis.diagnose import diagnose_prepared
    from dehyst.sim.diagnosis.prepare import prepare
    from dehyst.sim.stage.file import load_stage

    say = progress_printer(args.quiet)
    if args.test_range is not None and args.test is None:
        raise FieldError("--test-range", args.test_range, "a test recording", "give it by --test")
    start = time.perf_counter()
    nominal = load_stage(args.stage) if args.stage is not None else args.nominal
    recording = load(args.data, args, args.range)
    test = None if args.test is None else load(args.test, args, args.test_range, test=True)
    check_folder(args.out)
    prepared = prepare(recording, nominal=nominal, test=test)
    say(describe(recording, list(prepared.findings)))
    for note in prepared.notes:
        say(f"  {note}")
    findings = [f.message for f in prepared.findings] + list(prepared.notes)
    if test is not None and prepared.test is not None:
        say(describe(test, list(prepared.test.findings)))
        findings += [f"{args.test.name}: {f.message}" for f in prepared.test.findings]

    def progress(stage: str, share: float) -> None:
        say(f"[{100.0 * share:3.0f} %] {stage} ({time.perf_counter() - start:.1f} s)")

    diagnosis = diagnose_prepared(prepared, seed=args.seed, progress=progress)
    progress("writing the report", 0.97)
    source = Source(
        args.data.name,
        findings=tuple(findings),
        test="" if args.test is None else args.test.name,
        nominal=str(args.stage.name) if args.stage is not None else args.nominal,
    )
    data = write_report(args.out, diagnosis, source)
    say(f"[100 %] done in {time.perf_counter() - start:.1f} s")
    print(json.dumps(data) if args.json else summary(data, args.out))
    return 0


def summary(data: dict[str, Any], out: Path) -> str:
    """The verdict as text."""
    lines = [
        f"verdict: {data['verdict']}",
        f"held-out free-run error: nominal {data['nominal']['heldout_rmse_um']:.4g} µm, extended "
        f"{data['extended']['heldout_rmse_um']:.4g} µm, noise floor {data['noise_floor_um']:.4g} µm",
    ]
    for effect in data["effects"]:
        numbers = ", ".join(f"{k} = {v:.4g}" for k, v in list(effect["parameters"].items())[:6])
        also = f" (or {', '.join(effect['alternatives'])})" if effect["alternatives"] else ""
        lines.append(f"  {effect['name']}{also}: removes {100.0 * effect['heldout_gain']:.3g} %; {numbers}")
    if data["not_excited"]:
        lines.append(f"not excited: {', '.join(data['not_excited'])}")
    if data["next_experiment"]:
        lines.append(f"next: {data['next_experiment']}")
    lines.append(f"report: {out / 'report.md'}")
    return "\n".join(lines)
