"""``dehyst look``: what a file holds, what was understood, and the command that would use it.

Of two columns in V it asks which is which (exit status 1); the second example answers.

  dehyst look scope.csv
  dehyst look scope.csv --column u=CH1 --column y=CH2 --scale y=10

'dehyst stage --examples DIR' makes a folder with the files that these examples name.
"""

from __future__ import annotations

import argparse
import json
import shlex
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dehyst.adaptive.errors import InputError
from dehyst.service.cli.options import add_shared
from dehyst.service.identification.recording_options import add_mapping_arguments, mapping_from, to_fill_in
from dehyst.sim.recordings import Finding, Recording, check
from dehyst.sim.recordings.columns import MissingError
from dehyst.sim.recordings.reader import read, read_table
from dehyst.sim.recordings.table import Table

#: Most points of a line in the picture.
_POINTS = 4000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of ``dehyst look``."""
    parser.add_argument("data", type=Path, metavar="FILE", help="a recording: a file, or a folder of segments")
    parser.add_argument("--picture", type=Path, metavar="FILE.png", help="file for the picture (FILE.look.png, here)")
    add_shared(parser, "no-pictures", "json")
    add_mapping_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Read and describe. Returns 0 where the file is understood and usable, else 1."""
    mapping = mapping_from(args)
    table = read_table(args.data, mapping)
    recording, missing = None, ""
    options: tuple[str, ...] = ()
    try:
        recording = read(args.data, mapping)
    except MissingError as error:
        missing, options = str(error), error.options
    except InputError as error:
        missing = str(error)
    findings = check(recording) if recording is not None else []
    usable = recording is not None and all(finding.severity != "refusal" for finding in findings)
    picture = None
    if recording is not None and not args.no_pictures:
        picture = args.picture or Path(f"{args.data.name}.look.png")
        draw(picture, args.data.name, recording)
    found = {
        "file": str(args.data),
        "columns": _columns(table),
        "notes": list(table.notes),
        "understood": None if recording is None else _understood(recording),
        "findings": [finding.as_dict() for finding in findings],
        "missing": missing or None,
        "commands": commands(args, options, usable) if usable or options else [],
        "fill_in": to_fill_in(options),
        "picture": None if picture is None else str(picture),
    }
    print(json.dumps(found) if args.json else text(found, findings))
    return 0 if usable else 1


def _columns(table: Table) -> list[dict[str, Any]]:
    """Each column: smallest, largest and missing values of numbers; of texts the first one."""
    found = []
    for name, array in table.arrays.items():
        numbers = array.dtype.kind in "fiub"
        values = np.asarray(array if numbers else (), dtype=np.float64)
        good = values[np.isfinite(values)]
        ends = {"min": float(good.min()), "max": float(good.max())} if good.size else {"min": None, "max": None}
        first = None if numbers or not array.size else str(array.reshape(-1)[0])[:40]
        about = {"name": name, "unit": table.units.get(name), "shape": list(array.shape)}
        found.append({**about, **ends, "missing": int(values.size - good.size), "first": first})
    return found


def _understood(recording: Recording) -> dict[str, Any]:
    return {
        "samples": len(recording),
        "rate_Hz": 1.0 / recording.dt_s,
        "duration_s": recording.duration_s,
        "columns": list(recording.columns()),
        "u_V": _ends(recording.u_V),
        "y_um": _ends(recording.y_um),
        "y_unit": recording.y_unit,
    }


def _ends(values: NDArray[Any]) -> list[float]:
    """Smallest and largest finite value; NaN where there is none."""
    good = values[np.isfinite(values)]
    return [float(good.min()), float(good.max())] if good.size else [float("nan")] * 2


def commands(args: argparse.Namespace, options: tuple[str, ...], usable: bool) -> list[str]:
    """The commands that would use the file; with proposals to check where something is missing."""
    own = {str(args.data), "look", "--json", "--no-pictures", "--no-picture"}
    words = [word for word in args.given if word not in own]
    if args.picture is not None:
        words = [word for word in words if word not in ("--picture", str(args.picture), f"--picture={args.picture}")]
    file, said = shlex.quote(str(args.data)), " ".join([*(shlex.quote(word) for word in words), *options])
    said = f" {said}" if said else ""
    if not usable:
        return [f"dehyst look {file}{said}"]
    return [
        f"dehyst identify {file}{said} --out model.npz",
        f"dehyst diagnose {file}{said} --out out/report",
        f"dehyst replay {file}{said} --config serve.toml --model model.npz --out out/replay",
    ]


def text(found: dict[str, Any], findings: list[Finding]) -> str:
    """The result for people."""
    lines = [
        f"{found['file']}",
        f"  {'column':<28}{'unit':<10}{'values':>10}{'smallest':>14}{'largest':>14}{'missing':>9}",
    ]
    for column in found["columns"]:
        size = "x".join(map(str, column["shape"])) or "1"
        ends = [format(column[end], ".6g") if column[end] is not None else "-" for end in ("min", "max")]
        unit = column["unit"] or "-"
        lines.append(
            f"  {column['name'][:27]:<28}{unit[:9]:<10}{size:>10}{ends[0]:>14}{ends[1]:>14}{column['missing']:>9}"
        )
    lines += [f"  note: {note}" for note in found["notes"]]
    if found["understood"] is not None:
        u = found["understood"]
        u_V, y_um = ("{:.4g} to {:.4g}".format(*u[name]) for name in ("u_V", "y_um"))
        lines.append(
            f"understood: {u['samples']} samples, {u['duration_s']:.4g} s at {u['rate_Hz']:.6g} Hz; u {u_V} V, "
            f"y {y_um} {u['y_unit']}; columns {', '.join(u['columns'])}"
        )
        lines += [f"  {f.severity}: {f.message}" for f in findings if f.message not in found["notes"]]
    if found["missing"]:
        lines.append(f"not understood: {found['missing'].removeprefix(found['file'] + ': ')}")
    if found["missing"] and found["commands"]:
        lines.append(f"go on with this command, after you have checked its columns and units{found['fill_in']}:")
    elif found["commands"]:
        lines.append("use it by:")
    lines += [f"  {command}" for command in found["commands"]]
    lines += [f"picture: {found['picture']}"] if found["picture"] else []
    return "\n".join(lines)


def draw(path: Path, title: str, recording: Recording) -> None:
    """Voltage and displacement over time, and the loop. Raises OSError."""
    from dehyst.service.reports.plot_style import envelope, figure, label, line, save
    from dehyst.service.viewer.colours import MEASURED, TRAINING

    y_name = f"{'displacement' if recording.y_unit == 'µm' else 'angle'} y / {recording.y_unit}"
    drawn, axes = figure(2, 2, (12.0, 7.0), title, width_ratios=[1.4, 1.0])
    for row, (values, name) in enumerate(((recording.u_V, "voltage u / V"), (recording.y_um, y_name))):
        t_s, shown = envelope(recording.t_s, values, _POINTS)
        line(axes[row, 0], t_s, shown, color=(TRAINING, MEASURED)[row])
        label(axes[row, 0], "time / s", name, "")
    every = max(1, len(recording) // (10 * _POINTS))
    line(axes[0, 1], recording.u_V[::every], recording.y_um[::every], color=MEASURED)
    label(axes[0, 1], "voltage u / V", y_name, "loop")
    steps = np.diff(recording.t_s)
    line(axes[1, 1], recording.t_s[1:][:: max(1, every)], 1e3 * steps[:: max(1, every)], color=TRAINING)
    label(axes[1, 1], "time / s", "time since the sample before / ms", "sample times")
    save(drawn, path)
