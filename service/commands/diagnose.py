"""``dehyst diagnose``: what a recording holds that the simulation lacks, named, fitted and measured."""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

from service.recording_options import add_mapping_arguments, describe, load

EPILOG = """\
Writes DIR/report.md with its pictures, DIR/report.json (schema 1, see docs/diagnosis.md) and DIR/stage.toml, the
extended stage that `dehyst stage --file` runs. Displacements are in µm, voltages in V, times in s.

  dehyst diagnose recording.parquet --out out/diagnosis
  dehyst diagnose scope.csv --column y=CH2 --scale y=10 --column u=CH1 --unit u=V --dt-s 5e-4 --out out/diagnosis
  dehyst diagnose multisine.npz --stage linear --range 0:20 --out out/diagnosis --json
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of ``dehyst diagnose``."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = EPILOG
    parser.add_argument("data", type=Path, metavar="DATA", help="the recording: a file, or a folder of segments")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the report")
    parser.add_argument("--range", metavar="START:STOP", help="the part of the recording to use, s")
    parser.add_argument(
        "--stage",
        default="bouc_wen",
        choices=["bouc_wen", "linear"],
        help="the simulation to judge: the chapter's Bouc-Wen stage (default), or a linear one of second order",
    )
    parser.add_argument("--seed", type=int, default=0, help="of the null distribution (0)")
    parser.add_argument("--json", action="store_true", help="print report.json in place of the summary")
    add_mapping_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Read, check, diagnose, write. Returns 0."""
    from service.diagnosis_report import write_report
    from sim.diagnosis.diagnose import Options, diagnose
    from sim.diagnosis.prepare import prepare

    def say(text: str) -> None:
        print(text, file=sys.stderr, flush=True)

    start = time.perf_counter()
    recording = load(args.data, args, args.range)
    prepared = prepare(recording)
    say(describe(recording, list(prepared.findings)))
    for note in prepared.notes:
        say(f"  {note}")

    def progress(stage: str, share: float) -> None:
        say(f"[{100.0 * share:3.0f} %] {stage} ({time.perf_counter() - start:.1f} s)")

    diagnosis = diagnose(
        prepared.setting,
        prepared.mask,
        Options(nominal=args.stage, seed=args.seed),
        progress,
        prepared.notes,
        prepared.dropped,
    )
    findings = [f.message for f in prepared.findings] + list(prepared.notes)
    data = write_report(args.out, diagnosis, args.data.name, findings)
    say(f"[100 %] done in {time.perf_counter() - start:.1f} s")
    print(json.dumps(data) if args.json else summary(data, args.out))
    return 0


def summary(data: dict[str, Any], out: Path) -> str:
    """The verdict for people."""
    lines = [
        f"verdict: {data['verdict']}",
        f"held-out free-run error: nominal {data['nominal']['heldout_rmse_um']:.4g} µm, extended "
        f"{data['extended']['heldout_rmse_um']:.4g} µm, noise floor {data['noise_floor_um']:.4g} µm",
    ]
    for effect in data["effects"]:
        numbers = ", ".join(f"{k} = {v:.4g}" for k, v in effect["parameters"].items())
        also = f" (or {', '.join(effect['alternatives'])})" if effect["alternatives"] else ""
        lines.append(f"  {effect['name']}{also}: removes {100.0 * effect['heldout_gain']:.3g} %; {numbers}")
    if data["not_excited"]:
        lines.append(f"not excited: {', '.join(data['not_excited'])}")
    if data["next_experiment"]:
        lines.append(f"next: {data['next_experiment']}")
    lines.append(f"report: {out / 'report.md'}")
    return "\n".join(lines)
