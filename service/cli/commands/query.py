"""``dehyst query``: ask a running service for voltages, or for its status.

  dehyst query 40                              # the voltage for 40 µm at rest
  dehyst query 40 40.1 40.2 --model linear     # a trajectory, one sample time apart
  dehyst query --from trajectory.csv --json    # columns y,v,a
  dehyst query --status

'dehyst stage --examples DIR' makes a folder with the files that these examples name.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dehyst.adaptive.types import FloatArray
from dehyst.service.cli.options import add_connection, add_shared
from dehyst.service.protocol.errors import FieldError

if TYPE_CHECKING:
    from dehyst.service.protocol.query import Trajectory


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command, with units in the help."""
    add = parser.add_argument
    add("y_um", nargs="*", type=float, help="desired displacements, µm, one sample time apart")
    add(
        "--from",
        dest="source",
        metavar="FILE",
        help="read them from a CSV file with columns y[,v[,a]] instead, - for stdin",
    )
    add("--v", dest="v_um_per_s", type=float, metavar="UM/S", help="velocity of a single point, µm/s (0)")
    add("--a", dest="a_um_per_s2", type=float, metavar="UM/S2", help="acceleration of a single point, µm/s² (0)")
    add("--model", default="", metavar="NAME", help="model to ask (the one that the service serves)")
    add("--as-of", type=int, metavar="SEQ", help="answer from the snapshot that has seen no sample after this number")
    add("--status", action="store_true", help="print the status of the axis instead")
    add_shared(parser, "stage", "axis")
    add_connection(parser)
    add_shared(parser, json={"help": "print JSON"})


def run(args: argparse.Namespace) -> int:
    """Ask and print. Returns 0. Raises ServiceError where there is no answer or the service refuses."""
    from dehyst.service.client.client import Client
    from dehyst.service.protocol.query import NEWEST, flag_names

    columns = _columns(args)
    with Client.connect(
        args.endpoint, args.stage, args.axis, args.timeout, args.wait, zenoh_config=args.zenoh_config
    ) as client:
        if args.status:
            print(json.dumps(client.status(), indent=None if args.json else 2))
            return 0
        answer = client.trajectory(*columns, model=args.model, as_of=NEWEST if args.as_of is None else args.as_of)
    flags = [flag_names(bits) for bits in answer.flags.tolist()]
    if args.json:
        print(json.dumps(_as_json(columns[0], answer, flags)))
        return 0
    print(f"# model {answer.model}, snapshot {answer.snapshot_seq}{', fallback' if answer.fallback else ''}")
    print(f"# {'y_um':>10} {'u_V':>10} {'std_V':>9}  flags")
    for y, u, std, names in zip(columns[0], answer.u_V, answer.std_V, flags, strict=True):
        print(f"{y:12.4f} {u:10.5f} {std:9.5f}  {' '.join(names)}".rstrip())
    return 0


def _as_json(y_um: FloatArray, answer: Trajectory, flags: list[list[str]]) -> dict[str, Any]:
    return {
        "schema": 1,
        "model": answer.model,
        "snapshot_seq": answer.snapshot_seq,
        "fallback": answer.fallback,
        "y_um": y_um.tolist(),
        "u_V": answer.u_V.tolist(),
        "std_V": [None if math.isnan(value) else value for value in answer.std_V.tolist()],
        "flags": flags,
        "memory": answer.memory.tolist(),
    }


def _columns(args: argparse.Namespace) -> list[FloatArray]:
    """y, and v and a where given, from the command line or the file."""
    if args.status:
        return []
    if bool(args.y_um) == bool(args.source):
        raise FieldError("y_um", "both or neither", "displacements in µm as arguments, or a file by --from")
    if args.source:
        return _read(args.source)
    columns = [np.array(args.y_um)]
    if args.v_um_per_s is not None or args.a_um_per_s2 is not None:
        if len(args.y_um) != 1:
            raise FieldError("--v, --a", f"{len(args.y_um)} points", "a single point", "give columns by --from FILE")
        columns += [np.array([args.v_um_per_s or 0.0]), np.array([args.a_um_per_s2 or 0.0])]
    return columns


def _read(source: str) -> list[FloatArray]:
    try:
        text = sys.stdin.read() if source == "-" else Path(source).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise FieldError("--from", str(error), "a readable CSV file") from error
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    if lines and not re.match(r"\s*[-+.\d]", lines[0]):
        del lines[0]  # the names of the columns
    try:
        columns = np.loadtxt(lines, delimiter=",", ndmin=2, unpack=True) if lines else np.empty((0, 0))
        if not 1 <= len(columns) <= 3:
            raise ValueError(f"{columns.shape[1]} rows of {len(columns)} columns")
    except ValueError as error:
        expected = "one to three columns y[,v[,a]] of numbers in µm, µm/s, µm/s², the same in all rows"
        raise FieldError(source, str(error), expected) from error
    return [column.copy() for column in columns]
