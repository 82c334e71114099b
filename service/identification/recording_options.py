"""Command-line options that describe the columns of a recording, shared by all commands that read one.

Columns: t_s, u_V, y_um and, where present, u2_V, y2_um, monitor_V, temperature_C. Other names and units are given by
options (or once and for all in a TOML file of the same words), never guessed. Formats by ending: .csv and other
text with or without a header line, .tdms of LabVIEW, .mat of every version, .h5, .npy, .npz, .xlsx, .parquet
(or a folder of a recorder's segments), .feather, .json. Examples: docs/recordings.md.
"""

from __future__ import annotations

import argparse
import re
import shlex
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from dehyst.adaptive.errors import InputError
from dehyst.service.cli.options import check_number
from dehyst.service.protocol.errors import FieldError
from dehyst.sim.recordings import ColumnMap, Finding, Recording, load_map, read
from dehyst.sim.recordings.columns import QUANTITIES, MissingError

T = TypeVar("T")


def add_mapping_arguments(parser: argparse.ArgumentParser, *, test: bool = False) -> None:
    """Add the options from ``--map`` to ``--decimal`` that say how to read a recording.

    ``test`` adds ``--test-file``, for a command that reads a second recording by ``--test``.
    """
    quantities = ", ".join(QUANTITIES)
    units = "; ".join(f"{quantity}: {' '.join(factors)}" for quantity, (_, factors) in QUANTITIES.items())
    group = parser.add_argument_group("what the file's columns mean", (__doc__ or "").partition("\n\n")[2])
    group.add_argument(
        "--map", type=Path, metavar="FILE.toml", help="read these options from a file; the command line overrides it"
    )
    repeated = [
        ("--column", "Q=NAME",
         f"column of a quantity ({quantities}): its name or, in text and workbooks, its position from 1"),
        ("--unit", "Q=UNIT", f"its unit ({units})"),
        ("--scale", "Q=FACTOR", "factor to V, µm or s in place of a unit"),
        ("--index", "Q=:,0,2",
         "part of an array of several dimensions; '*' puts periods one after another: y=*,:"),
        ("--file", "Q=FILE", "the quantity is in this file, not in the first one"),
        ("--repeat", "Q",
         "the file holds one period of this quantity, to be repeated as long as the other columns last: u"),
    ]  # fmt: skip
    if test:
        repeated.append(("--test-file", "Q=FILE", "the same for the recording of --test"))
    else:
        parser.set_defaults(test_file=[])
        if parser.get_default("test") is None:
            parser.set_defaults(test=None)
    for option, values, text in repeated:
        group.add_argument(option, action="append", default=[], metavar=values, help=text)
    clock = group.add_mutually_exclusive_group()
    clock.add_argument("--dt-s", type=float, metavar="S", help="sample time, s, where the file has no time column")
    clock.add_argument("--rate", type=float, metavar="HZ", help="the same as a rate, samples per second")
    group.add_argument("--sensor-late", type=int, metavar="N", help="the sensor column is N samples late in the file")
    group.add_argument(
        "--header",
        metavar="LINE",
        help="line with the columns' names, from 1, or none (default: as the first line shows)",
    )
    group.add_argument("--delimiter", help="between the columns of a text file (default: as its first lines show)")
    group.add_argument("--decimal", choices=[".", ","], help="decimal sign of a text file (default: as its lines show)")


def mapping_from(args: argparse.Namespace, *, test: bool = False) -> ColumnMap:
    """The column mapping from the options and the file ``--map``, for the recording or for that of ``--test``.

    Raises InputError.
    """
    base = load_map(args.map) if args.map is not None else ColumnMap()
    scale, units = _pairs("--scale", args.scale, float), _pairs("--unit", args.unit, str)
    # An option overrides the file, also if one gives a unit and the other a scale.
    kept_units = {q: unit for q, unit in base.units.items() if q not in scale}
    kept_scale = {q: factor for q, factor in base.scale.items() if q not in units}
    names = ("dt_s", "sensor_late", "delimiter", "decimal", "header")
    scalars = {name: value for name in names if (value := getattr(args, name)) is not None}
    if args.rate is not None:
        check_number("--rate", args.rate, "Hz", low=0, above=True, high=1e9)
        scalars["dt_s"] = 1.0 / args.rate
    files = base.files | _pairs("--file", args.file, Path)
    if test:
        tested = _pairs("--test-file", args.test_file, Path)
        if tested.keys() != files.keys():
            raise FieldError(
                "--test-file",
                ", ".join(tested) or "nothing",
                f"a file for {', '.join(files) or 'no quantity'}, as the recording has",
                "the test recording is read like the recording itself",
            )
        files = tested
    return replace(
        base,
        files=files,
        repeat=tuple(args.repeat) or base.repeat,
        columns=base.columns | _pairs("--column", args.column, str),
        units=kept_units | units,
        scale=kept_scale | scale,
        index=base.index | _pairs("--index", args.index, str),
        **scalars,
    )


def _pairs(option: str, texts: list[str], kind: Callable[[str], T]) -> dict[str, T]:
    pairs: dict[str, T] = {}
    for text in texts:
        quantity, _, value = text.partition("=")
        try:
            if not value or quantity not in QUANTITIES:
                raise ValueError
            pairs[quantity] = kind(value)
        except ValueError:
            number = "a number and " if kind is float else ""
            expected = f"QUANTITY=VALUE with {number}one of {', '.join(QUANTITIES)}"
            raise FieldError(option, repr(text), expected) from None
    return pairs


def parse_range(option: str, text: str | None) -> tuple[float | None, float | None]:
    """``"2:40"`` as (2.0, 40.0) s; either end may be empty (None). Raises InputError."""
    if text is None:
        return None, None
    start, colon, stop = text.partition(":")
    try:
        if not colon:
            raise ValueError
        ends = (float(start) if start else None, float(stop) if stop else None)
        if ends[0] is not None and ends[1] is not None and not ends[0] < ends[1]:
            raise ValueError
    except ValueError:
        raise FieldError(
            option, repr(text), "START:STOP in s, the first below the second, either may be empty"
        ) from None
    return ends


def load(path: Path, args: argparse.Namespace, range_option: str | None = None, *, test: bool = False) -> Recording:
    """Read ``path`` with the options of :func:`add_mapping_arguments`, cut to ``range_option``.

    ``test`` says that it is the recording of ``--test``. Raises InputError.
    """
    if args.test_file and args.test is None:
        raise FieldError("--test-file", args.test_file[0], "a test recording", "give it by --test")
    try:
        recording = read(path, mapping_from(args, test=test))
    except MissingError as error:
        raise InputError(f"{error}\n{to_paste(args, error.options)}") from error
    start_s, stop_s = parse_range("--range", range_option)
    return recording if start_s is None and stop_s is None else recording.between(start_s, stop_s)


def to_paste(args: argparse.Namespace, options: Sequence[str]) -> str:
    """The command of the user with ``options`` added, to be pasted, and what to check in it."""
    given = " ".join(shlex.quote(word) for word in vars(args).get("given", ()))
    command = f"dehyst {given}" if given else f"dehyst {args.command}"
    return (
        f"To go on, check the columns and units in this command{to_fill_in(options)}:\n  {command} {' '.join(options)}"
    )


def to_fill_in(options: Sequence[str]) -> str:
    """What to fill in in proposed options, as the end of a sentence; "" for nothing."""
    found = []
    for option in options:
        _, quantity, word = re.split("[ =]", f"{option}=", maxsplit=2)
        word = word.rstrip("=") or quantity
        canonical, factors = QUANTITIES.get(quantity, ("", {}))
        own = canonical.rpartition("_")[2].replace("um", "µm")
        found += {
            "HZ": ["HZ (samples per second)"],
            "FILE": [f"FILE of {quantity} (the file with it)"],
            "FACTOR": [f"FACTOR of {quantity} ({own} per unit in the file)"],
            "UNIT": [f"UNIT of {quantity} ({', '.join(factors)})"],
        }.get(word, [])
    return f", and fill in {', '.join(found)}" if found else ""


def describe(recording: Recording, findings: list[Finding]) -> str:
    """A summary of the recording and the findings, as text."""
    extra = [name for name in recording.columns() if name not in ("t_s", "u_V", "y_um")]
    lines = [
        f"{recording.source}: {len(recording)} samples, {recording.duration_s:.4g} s at {1 / recording.dt_s:.6g} Hz"
        + (f", also {', '.join(extra)}" if extra else "")
    ]
    lines += [f"  {finding.severity}: {finding.message}" for finding in findings]
    return "\n".join(lines)
