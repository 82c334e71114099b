"""``dehyst export``: a model for a controller that runs without the service, as C, tables and an FMU.

The exported model is frozen: it learns no further, and no stand-in takes its place outside the learnt range (flag 4).

  dehyst export stage.npz --out exported                            # C with its test, and tables
  dehyst export stage.npz --out exported --model mpi --u-max 8 --slew 2000 --fmu
  dehyst export --from-service dehyst/v1/demo/x --out exported      # what a running service has learnt until now

'dehyst stage --examples DIR' makes a folder with the files that these examples name.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from dehyst.service.cli.options import add_connection, add_shared
from dehyst.service.protocol.errors import FieldError
from dehyst.service.protocol.keys import ROOT, Keys

if TYPE_CHECKING:
    from dehyst.service.answers.guard import Limits
    from dehyst.service.export.exporting import Frozen


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command, with units in the help."""
    add = parser.add_argument
    add("data", nargs="?", type=Path, metavar="MODEL.npz", help="model file from 'dehyst identify'")
    add("--from-service", metavar="KEY", help=f"take the model and limits of a running service: {ROOT}/STAGE/AXIS")
    add_shared(parser, out={"required": True, "metavar": "FOLDER", "help": "folder for the files; made where missing"})
    add("--model", default="", metavar="NAME", help="which model (the one with the least error when it was identified)")
    add("--name", default="", metavar="NAME", help="of files and C functions (STAGE_AXIS)")
    add("--u-min", type=float, metavar="V", help="lowest voltage, V (that of the recording)")
    add("--u-max", type=float, metavar="V", help="highest voltage, V (that of the recording)")
    add("--slew", type=float, metavar="V/S", help="largest change of the voltage, V/s (none)")
    add("--motion", metavar="LOW:HIGH", help="ends of the tables' periodic motion, µm (the learnt range)")
    add("--hz", type=float, default=1.0, metavar="HZ", help="its periods a second (%(default)g)")
    add("--fmu", action="store_true", help="compile an FMU 2.0 for co-simulation too (Linux; CC names the compiler)")
    add_connection(parser, timeout_s=5.0)


def run(args: argparse.Namespace) -> int:
    """Export. Returns 0. Raises InputError and ServiceError with what is wrong."""
    from dehyst.service.export.exporting import compiler, write_export
    from dehyst.service.storage.output import clear_output

    if (args.data is None) == (args.from_service is None):
        raise FieldError("MODEL.npz, --from-service", "both or neither", "a model file, or the key of a service")
    motion = _motion(args.motion)
    clear_output(args.out)
    if args.fmu:
        compiler()
    frozen = _from_service(args) if args.from_service else _from_file(args)
    print(frozen.origin)
    print("\n".join(f"  {line}" for line in write_export(frozen, args.out, motion, args.hz, args.fmu)))
    return 0


def _motion(text: str | None) -> tuple[float, float] | None:
    if text is None:
        return None
    try:
        low, high = map(float, text.split(":"))
    except ValueError as error:
        raise FieldError("--motion", repr(text), "LOW:HIGH in µm, such as 10:70") from error
    return low, high


def _from_file(args: argparse.Namespace) -> Frozen:
    from dehyst.service.export.exporting import Frozen
    from dehyst.service.storage.model_file import read_bundle

    bundle = read_bundle(args.data)
    meta, errors = bundle.meta, bundle.meta.notes.get("heldout_rmse_um") or {}
    name = args.model or min(bundle.models, key=lambda name: errors.get(name, float("inf")))
    if name not in bundle.models:
        raise FieldError("--model", repr(name), f"one of {', '.join(bundle.models)}")
    origin = f"dehyst: {name} of {args.data.name}, identified from {meta.source or 'no recording'}"
    limits = _limits(args, meta.u_min_V, meta.u_max_V)
    return Frozen(bundle.models[name], limits, args.name or _joined(meta.stage, meta.axis), origin)


def _from_service(args: argparse.Namespace) -> Frozen:
    from dehyst.service.client.client import Client
    from dehyst.service.export.exporting import Frozen

    parts = args.from_service.removeprefix(f"{ROOT}/").split("/")
    if len(parts) != 2:
        raise FieldError("--from-service", repr(args.from_service), f"{ROOT}/STAGE/AXIS")
    keys = Keys(*parts)
    with Client.connect(
        args.endpoint, keys.stage, keys.axis, args.timeout, args.wait, zenoh_config=args.zenoh_config
    ) as client:
        follower, limits = client.follow(args.model, deltas=False), client.limits
        origin = f"dehyst: {follower.name} of {keys.base} after sample {follower.snapshot_seq}"
    limits = _limits(args, limits.u_min_V, limits.u_max_V, limits)
    return Frozen(follower.model, limits, args.name or _joined(keys.stage, keys.axis), origin)


def _limits(
    args: argparse.Namespace, u_min_V: float | None, u_max_V: float | None, known: Limits | None = None
) -> Limits:
    """The limits of the recording or the service, with those of the command line in their place."""
    from dehyst.service.answers.guard import Limits

    low, high = (given if given is not None else own for given, own in ((args.u_min, u_min_V), (args.u_max, u_max_V)))
    if low is None or high is None:
        raise FieldError("--u-min, --u-max", "none", "limits in V", "this model file holds no range of a recording")
    slew = args.slew if args.slew is not None else known.slew_V_per_s if known else float("inf")
    return Limits(low, high, slew, *((known.y_min_um, known.y_max_um) if known else ()))


def _joined(stage: str, axis: str) -> str:
    return f"{stage}_{axis}".replace("-", "_")
