"""``dehyst rehearse``: identify your own simulated stage, close the loop, and disturb it."""

from __future__ import annotations

import argparse
import functools
import json
import math
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

from dehyst.adaptive.errors import InputError
from dehyst.service.cli.options import add_epilog, add_shared, check_seed, progress_printer
from dehyst.service.cli.python_file import load_object
from dehyst.service.protocol.errors import FieldError
from dehyst.service.runtime.stopping import StopSignal

EPILOG = """\
FILE.py:NAME is a Python class, function or object: voltages of a block in (V), true displacement and reading out (µm).
It has the attributes dt_s (s), u_min_V and u_max_V (V), or the options above give them. The code in FILE.py is run.
A stage file is that of `dehyst stage`, or what `dehyst diagnose` wrote.
Errors are in percent of the commanded range. Exit status 1 if a run ends at a voltage limit, stays above 5 % for longer
than 0.1 s, or follows a wrong sensor.

  dehyst rehearse --plant examples/plant.py:Stage
  dehyst rehearse --plant mystage.toml --events none,gain_at_once
  dehyst rehearse --plant mine.py:run --rate 1000 --u-min 0 --u-max 100 --events none,knock,gain_at_once
"""

#: Files that the command writes; it removes those of an earlier run first.
OURS = ("rehearsal.json", "rehearsal.md", "rehearsal.png")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command, with units in the help."""
    add_epilog(parser, EPILOG, files=True)
    add = parser.add_argument
    add("--plant", required=True, metavar="FILE.py:NAME", help="the simulated stage; or a stage file, FILE.toml")
    add("--rate", type=float, metavar="HZ", help="samples a second, Hz, where the plant has no dt_s")
    add("--u-min", type=float, metavar="V", help="lowest voltage of the drive, V, where the plant has no u_min_V")
    add("--u-max", type=float, metavar="V", help="highest voltage of the drive, V, where the plant has no u_max_V")
    add("--events", metavar="A,B", help="kinds of events, 'list' prints them (one of each category)")
    add_shared(parser, seed={"help": "seed of the reference and of the events (%(default)s)"})
    add("--settle", type=float, default=4.0, metavar="S", help="closed loop before the event, s (4)")
    add("--after", type=float, default=5.0, metavar="S", help="closed loop after the event, s (5)")
    add("--controllers", type=_ages, default=(), metavar="1,5,20",
        help="also other controllers, and the corrections, with readings so many samples old (none)")  # fmt: skip
    add("--mode-hz", type=float, default=100.0, metavar="HZ",
        help="lowest frequency at which the stage rings, for them, Hz (%(default)g)")  # fmt: skip
    add_shared(
        parser,
        "no-pictures",
        "quiet",
        out={"default": Path("out/rehearsal"), "help": "folder for the results (%(default)s)"},
        json={"help": "print rehearsal.json in place of the table"},
    )


def _plant(where: str) -> object:
    """The plant that ``--plant`` names: an object of a Python file, or a stage file. Raises FieldError, InputError."""
    if Path(where).suffix not in (".toml", ".json"):
        return load_object("--plant", where, "examples/plant.py:Stage")
    from dehyst.lab.rehearsal.plant import StagePlant
    from dehyst.sim.stage.file import load_stage

    return functools.partial(StagePlant, load_stage(where))


def _ages(text: str) -> tuple[int, ...]:
    """Numbers of samples, with commas between them. Raises ArgumentTypeError where one is none."""
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError as error:
        message = f"got {text!r}, expected ages in samples, with commas between them: 1,5,20"
        raise argparse.ArgumentTypeError(message) from error


def run(args: argparse.Namespace) -> int:
    """Load, identify, run, draw. Returns 0 if no run failed, else 1."""
    from dehyst.lab.rehearsal import (
        CLASSES,
        EVENT_KINDS,
        STANDARD,
        RehearsalConfig,
        controllers,
        factory_of,
        rehearse,
        standard_events,
    )
    from dehyst.lab.rehearsal.plant import excitation_range
    from dehyst.lab.rehearsal.rehearsal import remarks, table
    from dehyst.service.reports.tables import json_form
    from dehyst.service.storage.output import clear_output

    if args.events == "list":
        for name, (kind_name, _) in CLASSES.items():
            kind = EVENT_KINDS[kind_name]
            print(f"{name:<18}{kind.category:<8}{kind.text}{'' if name in STANDARD else ' (not standard)'}")
        return 0
    check_seed(args.seed)
    if args.rate is not None and not (math.isfinite(args.rate) and args.rate > 0.0):
        raise FieldError("--rate", args.rate, "samples a second, above 0 Hz")
    if any(age < 1 for age in args.controllers):
        raise FieldError("--controllers", min(args.controllers), "ages of readings, 1 sample or more")
    if not 0.0 < args.mode_hz < math.inf:
        raise FieldError("--mode-hz", args.mode_hz, "a frequency, Hz")
    stop = StopSignal(raising=True)
    config = RehearsalConfig(settle_s=args.settle, after_s=args.after)
    names = args.events.split(",") if args.events else STANDARD
    events = standard_events(args.seed, config.settle_s, names)
    given = _plant(args.plant)
    factory = factory_of(given, 1.0 / args.rate if args.rate else None, args.u_min, args.u_max)
    clear_output(args.out, OURS)
    begin = time.perf_counter()
    total = len(events) + len(args.controllers) * len(controllers.REPEATING)
    said: list[str] = []
    show = progress_printer(args.quiet)

    def progress(what: str, share: float) -> None:
        stop.look()
        # One line where an event begins, with its number in the list.
        if not said or said[-1] != what:
            said.append(what)
            number = f"[{len(said) - 1}/{total}] " if len(said) > 1 else ""
            show(f"{number}{what} ...")

    done = rehearse(factory, config=config, events=events, seed=args.seed, progress=progress)
    low_V, _ = excitation_range(factory(), config)
    compared = controllers.compare(factory, done.identified, low_V, args.mode_hz, args.controllers, args.seed, progress)
    summary: dict[str, Any] = done.as_dict() | {
        "controllers": json_form([asdict(one) for one in compared]),
        "plant": args.plant,
        "seconds": round(time.perf_counter() - begin, 2),
    }

    def made(markdown: bool = False) -> list[str]:
        rows = [controllers.table(compared, markdown)] if compared else []
        return [table(done, markdown), *rows]

    try:
        (args.out / "rehearsal.json").write_text(json.dumps(summary, indent=1) + "\n", encoding="utf-8")
        (args.out / "rehearsal.md").write_text("\n\n".join(made(markdown=True)) + "\n", encoding="utf-8")
        if not args.no_pictures:
            from dehyst.lab.rehearsal.rehearsal import draw_rehearsal

            draw_rehearsal(args.out / "rehearsal.png", done)
    except OSError as error:
        raise InputError(f"--out: got {args.out}, expected a folder that can be written to: {error}") from error
    if args.json:
        print(json.dumps(summary))
    else:
        print("\n\n".join(made()))
        show(f"done in {summary['seconds']:.0f} s; in {args.out}/: {', '.join(OURS)}")
    return 1 if any(failed(remarks(entry.outcome)) for entry in done.runs) else 0


def failed(marks: list[str]) -> bool:
    """Whether a remark is more than an event of the axis."""
    return any(not mark.startswith("said: ") for mark in marks)
