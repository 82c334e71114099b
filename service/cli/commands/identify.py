"""``dehyst identify``: the inverse models of a stage from a recording.

Errors are of the inverse: the model gets the measured motion of data it has not seen, and its voltage is compared with
the applied one. The error in µm is that voltage error times the mean gain of the stage.

  dehyst identify recording.csv --out stage.npz
  dehyst identify scope.csv --column t=Time --unit t=ms --column u=CH1 --unit u=V --column y=CH2 --scale y=10 \\
      --out stage.npz
  dehyst identify train.csv --test test.csv --range 1:11 --out stage.npz

'dehyst stage --examples DIR' makes a folder with the files that these examples name.
"""

from __future__ import annotations

import argparse
import json
import logging
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dehyst.adaptive.errors import InputError
from dehyst.service.cli.options import add_shared, check_number, progress_printer
from dehyst.service.identification.recording_options import add_mapping_arguments, describe, load
from dehyst.service.protocol.errors import FieldError
from dehyst.service.protocol.keys import check_name

#: A finding after which a model ends where the sensor did.
CLIPPED = ("clipped", "warning")

log = logging.getLogger("dehyst.identify")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of ``dehyst identify``."""
    parser.add_argument("data", type=Path, metavar="DATA", help="the recording: a file, or a folder of segments")
    add_shared(parser, "range", out={"required": True, "metavar": "MODEL.npz", "help": "file for the models"})
    judged = parser.add_mutually_exclusive_group()
    judged.add_argument("--holdout", type=float, default=0.25, help="share at the end held out for judging (0.25)")
    add_shared(judged, test={"help": "judge on this recording instead"})
    add_shared(parser, "test-range")
    add = parser.add_argument
    add("--keep-apart", action="store_true", help="write the models that never saw the held-out part (default: "
        "identify again from all of the recording)")  # fmt: skip
    add("--models", metavar="A,B", help="which models (all five)")
    add("--fit-samples", type=int, default=100_000, metavar="N",
        help="most samples for the fits; of a longer recording every k-th one is used (%(default)s)")  # fmt: skip
    add("--support", type=int, default=500, metavar="N", help="support vectors of the LSSVMs (500)")
    add_shared(parser, "stage", "axis")
    add("--picture", type=Path, metavar="FILE.png", help="file for the picture (beside the models)")
    add_shared(parser, "no-pictures", "quiet", "json")
    add_mapping_arguments(parser, test=True)


def run(args: argparse.Namespace) -> int:
    """Read, check, identify, judge, write. Returns 0, or 1 where no model could be identified."""
    from dehyst.service.identification import identifying
    from dehyst.service.identification.identifying import NAMES, Stretch
    from dehyst.service.storage.model_file import BundleMeta, write_bundle
    from dehyst.service.storage.output import check_file
    from dehyst.sim.recordings import check, repaired, require_usable

    check_name("--stage", args.stage)
    check_name("--axis", args.axis)
    names = tuple(args.models.split(",")) if args.models else NAMES
    if unknown := [name for name in names if name not in NAMES]:
        raise FieldError("--models", repr(unknown[0]), f"some of {', '.join(NAMES)}")
    check_number("--support", args.support, "support vectors", low=10)
    check_number("--fit-samples", args.fit_samples, "samples", low=1000)
    picture = None if args.no_pictures else args.picture or args.out.with_suffix(".png")
    check_file("--out", args.out)
    if picture is not None:
        check_file("--picture", picture)

    # Progress and findings go to stderr: with --json, stdout has nothing but JSON.
    say = progress_printer(args.quiet)
    start = time.perf_counter()
    recording = load(args.data, args, args.range)
    findings = check(recording)
    say(describe(recording, findings))
    require_usable(recording, findings)
    whole_repaired = repaired(recording)
    for line in whole_repaired.done:
        say(f"  repaired: {line}")
    dt_s = recording.dt_s
    every = identifying.thinning(len(whole_repaired.valid), dt_s, args.fit_samples)
    if every > 1:
        say(
            f"  long recording: fits and errors use one of {every} samples, one each {dt_s * every:g} s; motion "
            f"faster than {0.1 / (dt_s * every):.0f} Hz is judged more roughly (--fit-samples)"
        )
    whole, repairs = Stretch.of(whole_repaired, every), whole_repaired.done
    samples, sha256, y_unit = len(recording), recording.sha256, recording.y_unit
    # A long recording takes a gigabyte, and the fits need as much.
    del recording, whole_repaired
    if args.test is not None:
        tested = load(args.test, args, args.test_range, test=True)
        if abs(tested.dt_s / dt_s - 1.0) > 1e-3:
            raise InputError(
                f"{args.test}: sample time: got {tested.dt_s:g} s, expected {dt_s:g} s as in {args.data}: resample it"
            )
        test_findings = check(tested)
        say(describe(tested, test_findings))
        require_usable(tested, test_findings)
        train, test, again = whole, Stretch.of(repaired(tested), every), None
        judged_on = str(args.test)
    else:
        split = identifying.split_at(len(whole), args.holdout)
        train, test = whole.part(0, split), whole.part(split, len(whole))
        again = None if args.keep_apart else whole
        judged_on = f"the last {100 * args.holdout:g} % of the recording"

    results = identifying.identify_all(
        train, test, dt_s * every, follows=args.test is None, whole=again, names=names, n=args.support,
        most=args.fit_samples, serve_dt_s=dt_s, progress=_progress(say, names, len(train), len(again or train)),
    )  # fmt: skip
    models = {result.name: result.model for result in results if result.model is not None}
    for result in results:
        if result.failed:
            say(f"  {result.name}: not identified: {result.failed}")
    if not models:
        log.error("no model could be identified")
        return 1
    gain = float(np.polyfit(train.u_V, train.y_um, 1)[0])
    notes = {
        "judged_on": Path(judged_on).name if args.test is not None else judged_on,
        "heldout_rmse_um": {r.name: r.score.rmse_um for r in results if r.score is not None},
        "sensor_late": args.sensor_late or 0,
        "y_unit": y_unit,
        "fitted_from_every": every,
        "clipped": [finding.message for finding in findings if (finding.kind, finding.severity) == CLIPPED],
    }
    y_um, u_V = ((float(values.min()), float(values.max())) for values in (whole.motion[:, 0], whole.u_V))
    meta = BundleMeta(args.stage, args.axis, dt_s, args.data.name, sha256, *y_um, *u_V, notes)
    write_bundle(args.out, models, meta)
    if picture is not None:
        title = f"{args.data.name}: inverse models, judged on {judged_on}"
        identifying.draw_identification(picture, title, train, test, dt_s * every, results, gain)
    summary: dict[str, Any] = {
        "data": str(args.data),
        "sha256": sha256,
        "samples": samples,
        "fitted_from_every": every,
        "dt_s": dt_s,
        "range_um": float(np.ptp(train.motion[:, 0])),
        "gain_um_per_V": gain,
        "y_unit": y_unit,
        "judged_on": judged_on,
        "findings": [finding.as_dict() for finding in findings],
        "repaired": list(repairs),
        "models": {result.name: result.as_dict() for result in results},
        "out": str(args.out),
        "picture": str(picture) if picture else None,
        "seconds": round(time.perf_counter() - start, 2),
    }
    print(json.dumps(summary) if args.json else table(summary))
    return 0


def _progress(
    say: Callable[[str], None], names: Sequence[str], samples: int, all_samples: int
) -> Callable[[str, str, float], None]:
    """Prints each phase with its samples, the time passed and, from a tenth of the work on, the time left."""
    begun = time.perf_counter()

    def begin(name: str, phase: str, share: float) -> None:
        passed_s = time.perf_counter() - begun
        left = f", about {passed_s * (1.0 - share) / share:.0f} s left" if share > 0.1 else ""
        count = all_samples if phase.endswith("all") else samples
        number = f"[{names.index(name) + 1}/{len(names)}]"
        say(f"{number} identifying {name}: {phase}, {count} samples ({passed_s:.0f} s{left})")

    return begin


def table(summary: dict[str, Any]) -> str:
    """The held-out errors as text."""
    unit = summary["y_unit"]
    in_unit = [f"{name}/{unit}" for name in ("MAE", "RMSE", "max")]
    lines = [
        f"Free-run error of the inverse on {summary['judged_on']}, {summary['range_um']:.4g} {unit} range, "
        f"{summary['gain_um_per_V']:.4g} {unit}/V",
        f"{'model':<16}{'MAE/mV':>9}{'RMSE/mV':>9}{'max/mV':>9}   {in_unit[0]:>8}{in_unit[1]:>9}{in_unit[2]:>8}"
        f"   {'MAE/%':>7}{'RMSE/%':>8}   {'time/s':>6}",
    ]
    for name, entry in summary["models"].items():
        score = entry["heldout"]
        if score is None:
            lines.append(f"{name:<16}  {entry['failed']}")
            continue
        lines.append(
            f"{name:<16}{1e3 * score['mae_V']:9.2f}{1e3 * score['rmse_V']:9.2f}{1e3 * score['max_V']:9.2f}   "
            f"{score['mae_um']:8.4f}{score['rmse_um']:9.4f}{score['max_um']:8.3f}   "
            f"{score['mae_pct']:7.3f}{score['rmse_pct']:8.3f}   {entry['seconds']:6.2f}"
        )
    lines.append(f"models: {summary['out']}" + (f"; picture: {summary['picture']}" if summary["picture"] else ""))
    lines.append(
        f'next: dehyst serve --config FILE (with model = "{summary["out"]}"); an example: dehyst serve --example'
    )
    return "\n".join(lines)
