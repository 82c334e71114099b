"""Compare configuration parsers: ours, msgspec and pydantic, by start-up time and by what their errors say.

``python -m benchmarks.configuration --python PATH`` with the interpreter of an environment that has msgspec and
pydantic beside this project's path. Every parser reads the same example file by the same schema, with the same types,
defaults and bounds. Time: a new process each, from its first line to the parsed file, median of ``--runs`` in turns.
Errors: does the message have the field's path, the value that was got, what was expected, and what to do?
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
_PREPARE = """
import sys, time, math, tomllib, dataclasses, typing, pathlib, re, functools, types
import numpy
start = time.perf_counter()
"""
_OURS = """
from dataclasses import dataclass
from typing import Annotated as A
from pathlib import Path
from service.config.schema import Setting as S, build_settings
def low(l, h): return S(low=l, high=h)
@dataclass(frozen=True)
class Axis:
    name: str; model: Path; u_min_V: float; u_max_V: float; slew_V_per_s: float
    y_min_um: float = -math.inf; y_max_um: float = math.inf
    served: str = "auto"; learn: str = "lssvm_adaptive"; compete: tuple[str, ...] = ("linear", "mpi", "bouc_wen")
    snapshot_every: A[int, low(1, 100000)] = 20; snapshots_kept: A[int, low(1, 4096)] = 256
    queue_samples: A[int, low(1, 10000000)] = 20000; model_hz: A[float, low(0, 1000)] = 50.0
    recorder: Path | None = None; recorder_bytes: A[int, low(1000000, 10**15)] = 2000000000
    checkpoints: Path | None = None; checkpoint_s: A[float, low(0.05, 86400)] = 1.0
    checkpoints_kept: A[int, low(2, 10000)] = 32; stand_in: str = ""
    blend_share: A[float, low(0, 100)] = 0.5; stale_s: A[float, low(0, 1e9)] = 2.0
    last_good_s: A[float, low(0, 1e9)] = 60.0
@dataclass(frozen=True)
class Serve:
    stage: str; axis: tuple[Axis, ...]; listen: tuple[str, ...] = (); connect: tuple[str, ...] = ()
    zenoh_config: Path | None = None; standby_listen: tuple[str, ...] = (); lease_s: A[float, low(0.1, 60)] = 1.0
    insecure_beyond_loopback: bool = False
def parse(text): return build_settings(Serve, tomllib.loads(text), "f:")
"""
_MSGSPEC = """
import msgspec
from msgspec import Meta
from typing import Annotated as A
def low(l, h): return Meta(ge=l, le=h)
class Axis(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    name: str; model: str; u_min_V: float; u_max_V: float; slew_V_per_s: float
    y_min_um: float = -math.inf; y_max_um: float = math.inf
    served: str = "auto"; learn: str = "lssvm_adaptive"; compete: tuple[str, ...] = ("linear", "mpi", "bouc_wen")
    snapshot_every: A[int, low(1, 100000)] = 20; snapshots_kept: A[int, low(1, 4096)] = 256
    queue_samples: A[int, low(1, 10000000)] = 20000; model_hz: A[float, low(0, 1000)] = 50.0
    recorder: str | None = None; recorder_bytes: A[int, low(1000000, 10**15)] = 2000000000
    checkpoints: str | None = None; checkpoint_s: A[float, low(0.05, 86400)] = 1.0
    checkpoints_kept: A[int, low(2, 10000)] = 32; stand_in: str = ""
    blend_share: A[float, low(0, 100)] = 0.5; stale_s: A[float, low(0, 1e9)] = 2.0
    last_good_s: A[float, low(0, 1e9)] = 60.0
class Serve(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    stage: str; axis: tuple[Axis, ...]; listen: tuple[str, ...] = (); connect: tuple[str, ...] = ()
    zenoh_config: str | None = None; standby_listen: tuple[str, ...] = (); lease_s: A[float, low(0.1, 60)] = 1.0
    insecure_beyond_loopback: bool = False
def parse(text): return msgspec.convert(tomllib.loads(text), Serve)
"""
_PYDANTIC = """
from pydantic import BaseModel, ConfigDict, Field
from typing import Annotated as A
from pathlib import Path
def low(l, h): return Field(ge=l, le=h)
class Strict(BaseModel): model_config = ConfigDict(frozen=True, extra="forbid")
class Axis(Strict):
    name: str; model: Path; u_min_V: float; u_max_V: float; slew_V_per_s: float
    y_min_um: float = -math.inf; y_max_um: float = math.inf
    served: str = "auto"; learn: str = "lssvm_adaptive"; compete: tuple[str, ...] = ("linear", "mpi", "bouc_wen")
    snapshot_every: A[int, low(1, 100000)] = 20; snapshots_kept: A[int, low(1, 4096)] = 256
    queue_samples: A[int, low(1, 10000000)] = 20000; model_hz: A[float, low(0, 1000)] = 50.0
    recorder: Path | None = None; recorder_bytes: A[int, low(1000000, 10**15)] = 2000000000
    checkpoints: Path | None = None; checkpoint_s: A[float, low(0.05, 86400)] = 1.0
    checkpoints_kept: A[int, low(2, 10000)] = 32; stand_in: str = ""
    blend_share: A[float, low(0, 100)] = 0.5; stale_s: A[float, low(0, 1e9)] = 2.0
    last_good_s: A[float, low(0, 1e9)] = 60.0
class Serve(Strict):
    stage: str; axis: tuple[Axis, ...]; listen: tuple[str, ...] = (); connect: tuple[str, ...] = ()
    zenoh_config: Path | None = None; standby_listen: tuple[str, ...] = (); lease_s: A[float, low(0.1, 60)] = 1.0
    insecure_beyond_loopback: bool = False
def parse(text): return Serve.model_validate(tomllib.loads(text))
"""
PARSERS = {"ours": _OURS, "msgspec": _MSGSPEC, "pydantic": _PYDANTIC}
_FINISH = """
text = pathlib.Path(sys.argv[1]).read_text()
parse(text)
print(1e3 * (time.perf_counter() - start))
"""
_ERRORS = """
import json
text = pathlib.Path(sys.argv[1]).read_text()
told = []
for old, new in json.loads(sys.argv[2]):
    try:
        parse(text.replace(old, new, 1))
        told.append("(accepted)")
    except Exception as error:
        told.append(f"{error}")
print(json.dumps(told))
"""
#: What is changed in the file, and what a message must hold: path, got, expected (one of several words), advice.
MISTAKES = (
    ("u_max_V = 10.0", "u_max_V = 10.0\numax = 3", "umax", "3", ("u_max_V",)),
    ("u_max_V = 10.0", "", "u_max_V", "nothing", ("number", "float")),
    ("u_max_V = 10.0", 'u_max_V = "10"', "u_max_V", "'10'", ("number", "float")),
    ("u_max_V = 10.0", "u_max_V = nan", "u_max_V", "nan", ("number",)),
    ("u_max_V = 10.0", "u_max_V = 10.0\nsnapshot_every = 0", "snapshot_every", "0", ("1 to 1", ">= 1", "equal to 1")),
    ("u_max_V = 10.0", "u_max_V = 10.0\nsnapshot_every = true", "snapshot_every", "true", ("integer", "int")),
    ('stage = "demo"', "stage = 5", "stage", "5", ("text", "str")),
    ("[[axis]]", "[axis]", "axis", "{", ("list of tables", "array", "tuple")),
)  # fmt: skip


def main() -> int:
    """Measure and print a Markdown table and every message."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--python", default=sys.executable, help="interpreter that has msgspec and pydantic")
    parser.add_argument("--runs", type=int, default=20)
    args = parser.parse_args()
    from service.config.reference import example

    with tempfile.TemporaryDirectory() as folder:
        full = Path(folder) / "full.toml"
        lines = [line.removeprefix("# ") for line in example().splitlines()[1:]]
        full.write_text("\n".join(line for line in lines if not line.startswith("[axis.")), encoding="utf-8")
        times: dict[str, list[float]] = {name: [] for name in PARSERS}
        for _ in range(args.runs):
            for name, program in PARSERS.items():
                times[name].append(float(_run(args.python, _PREPARE + program + _FINISH, str(full))))
        short = Path(folder) / "short.toml"
        short.write_text(example(), encoding="utf-8")
        wrong = json.dumps([case[:2] for case in MISTAKES])
        told = {
            name: json.loads(_run(args.python, _PREPARE + program + _ERRORS, str(short), wrong))
            for name, program in PARSERS.items()
        }
    print("| parser | import and parse, ms | field | got | expected |\n|---|---|---|---|---|")
    for name, messages in told.items():
        counts = [sum(column) for column in zip(*map(_parts, MISTAKES, messages), strict=True)]
        marks = " | ".join(f"{count} of {len(MISTAKES)}" for count in counts)
        print(f"| {name} | {statistics.median(times[name]):.1f} | {marks} |")
    for i, case in enumerate(MISTAKES):
        print(f"\n`{case[1].splitlines()[-1] if case[1] else 'without ' + case[0]}`\n")
        for name, messages in told.items():
            print(f"- {name}: {' '.join(messages[i].split())}")
    return 0


def _parts(case: tuple[str, str, str, str, tuple[str, ...]], message: str) -> tuple[bool, bool, bool]:
    _, _, path, got, expected = case
    lower = message.lower()
    told = message != "(accepted)"
    rest = lower.replace(path.lower(), "", 1)
    return (
        told and path.lower() in lower,
        told and got.lower() in rest,
        told and any(w.lower() in rest for w in expected),
    )


def _run(python: str, program: str, *args: str) -> str:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([python, "-c", program, *args], env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{python}: {done.stderr}")
    return done.stdout


if __name__ == "__main__":
    sys.exit(main())
