"""``dehyst modes``: the modes of a stage from periodic recordings, and how they change with the amplitude.

For periodic drives in steady state, such as random-phase multisines: one or several drives and outputs, and, for each
amplitude, at least as many realisations as drives. Recordings of the same rms count as realisations of one amplitude.
Writes DIR/report.md with its pictures, and DIR/report.json (schema 1, see docs/modes.md).

  dehyst modes low.npz high.npz --column u=u --unit u=V --column rate=fs_hz --out out/modes
  dehyst modes a.csv b.csv c.csv --column u=CH1,CH2,CH3 --unit u=V --column y=X,Y --unit y=nm --period 8192 \\
      --skip-periods 1 --out out/modes

'dehyst stage --examples DIR' makes a folder with the files that these examples name.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

from dehyst.service.cli.options import add_shared, check_number, progress_printer
from dehyst.service.identification.recording_options import add_mapping_arguments, mapping_from


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of ``dehyst modes``."""
    parser.add_argument("data", type=Path, nargs="+", metavar="RECORDING", help="recordings to fit, of any amplitudes")
    add_shared(
        parser,
        out={"required": True, "help": "folder for the report"},
        test={"nargs": "+", "default": [], "help": "recordings to judge by, of the same amplitudes; not fitted"},
    )
    add = parser.add_argument
    add("--period", type=int, metavar="N", help="length of a period, samples")
    add("--skip-periods", type=int, default=0, metavar="K", help="periods at the start that are not steady (0)")
    add("--hold-out", type=int, metavar="R", help="realisations to hold out at amplitudes without a test recording "
        "(a third, where enough remain)")  # fmt: skip
    add("--start-modes", type=int, default=30, metavar="N", help="pole pairs to start from; useless ones go (30)")
    add("--degree", type=int, metavar="D", help="of the polynomials in the amplitude (2, or what the amplitudes allow)")
    add_shared(parser, "no-pictures", "quiet", json={"help": "print report.json in place of the summary"})
    add_mapping_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Read, fit, judge, write. Returns 0."""
    from dehyst.service.reports.modes import write_modes
    from dehyst.service.storage.output import check_folder
    from dehyst.sim.modal import FitSettings, study
    from dehyst.sim.modal.reading import read_periodic

    check_number("--start-modes", args.start_modes, low=1)
    say = progress_printer(args.quiet)
    start = time.perf_counter()
    mapping = mapping_from(args)
    records = [read_periodic(path, mapping, args.period, args.skip_periods) for path in args.data]
    tests = [read_periodic(path, mapping, args.period, args.skip_periods) for path in args.test]
    for record in (*records, *tests):
        samples, drives, realisations, periods = record.u_V.shape
        say(
            f"{record.name}: {drives} drives, {record.y_um.shape[1]} outputs, {realisations} realisations of {periods} "
            f"periods of {samples} samples at {1.0 / record.dt_s:.6g} Hz, {record.amplitude_V:.4g} V rms"
        )
    check_folder(args.out)
    found = study(
        records,
        tests,
        FitSettings(start_modes=args.start_modes, degree=args.degree),
        args.hold_out,
        lambda text: say(f"[{time.perf_counter() - start:.1f} s] {text}"),
    )
    data = write_modes(args.out, found, pictures=not args.no_pictures)
    print(
        json.dumps(data)
        if args.json
        else summary(data, [mode.sentence(*_ends(data)) for mode in found.modes], args.out)
    )
    return 0


def _ends(data: dict[str, Any]) -> tuple[float, float]:
    return data["levels"][0]["amplitude_V"], data["levels"][-1]["amplitude_V"]


def summary(data: dict[str, Any], sentences: list[str], out: Path) -> str:
    """Errors by amplitude and the modes as text."""
    lines = [f"{len(data['modes'])} modes, {data['pairs']} pole pairs; mean rms error of the outputs:"]
    for level in data["levels"]:
        train = sum(level["train_um"]) / len(level["train_um"])
        held = "" if level["test_mean_um"] is None else f", held out {level['test_mean_um']:.4g} µm"
        noise = level["noise_of_the_mean_period_um"]
        floor = "" if noise is None else f", noise {sum(noise) / len(noise):.4g} µm"
        lines.append(f"  {level['amplitude_V']:.4g} V rms: training {train:.4g} µm{held}{floor}")
    if len(data["levels"]) > 1:
        lines += [f"  {sentence}" for sentence in sentences]
    else:
        lines += [f"  {m['frequency_hz'][0]:.5g} Hz, damping {100.0 * m['damping'][0]:.3g} %" for m in data["modes"]]
    lines += [f"note: {note}" for note in data["notes"]]
    lines.append(f"report: {out / 'report.md'}")
    return "\n".join(lines)
