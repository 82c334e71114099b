"""``dehyst stage``: a simulated stage as a process on zenoh.

The clock starts when the first commands (sequence number 0) of every axis have arrived, or at once with --free-run.
Where a voltage is late, the stage repeats the last one and counts it. The last line printed is JSON: ticks, late
ticks, and per axis the samples published and the commands received, late, missing and refused.

  dehyst stage --listen tcp/127.0.0.1:7448 --free-run --duration 10
  dehyst stage --endpoint tcp/127.0.0.1:7447 --axis x --twins a,b --change 30:gain_drift.gain=-0.06
  dehyst stage --examples .              # write the files that the examples of all commands name, and exit
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from dataclasses import replace
from pathlib import Path

from dehyst.service.cli.options import add_shared, check_number
from dehyst.service.protocol.errors import FieldError
from dehyst.service.runtime.session import DEFAULT_ENDPOINT, check_endpoint
from dehyst.service.runtime.stopping import StopSignal
from dehyst.sim.stage.config import ParameterChange, StageConfig


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of ``dehyst stage``."""
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--preset", default="rich", help="rich (default: stands in for hardware) or bouc_wen")
    what.add_argument("--file", type=Path, metavar="STAGE.toml", help="a stage file in place of a preset")
    where = parser.add_mutually_exclusive_group()
    where.add_argument(
        "--endpoint", metavar="ENDPOINT", help=f"connect to a service or router (default {DEFAULT_ENDPOINT})"
    )
    where.add_argument("--listen", metavar="ENDPOINT", help="listen there instead, for controllers without a service")
    add = parser.add_argument
    add("--name", default="demo", help="name of the stage on the wire (%(default)s)")
    add_shared(parser, axis={"help": "name of its axis on the wire (%(default)s)"})
    add("--axis2", default="", metavar="NAME", help="also drive the second axis of the stage, under this name (at 0 V)")
    add("--twins", default="", metavar="A,B", help="further axes: equal stages with their own commands")
    add("--rate", type=float, metavar="HZ", help="sample rate, Hz (the stage's own, 1000 in presets)")
    add("--batch", type=int, default=1, metavar="N", help="samples in a message; more for a slow network (%(default)s)")
    add_shared(parser, "duration", seed={"default": None, "help": "seed of its noise and drift (the stage's own)"})
    add("--free-run", action="store_true", help="start at once, at 0 V until commands come")
    add("--change", action="append", default=[], metavar="T:NAME=VALUE[,...]",
        help="change parameters T s after the start, such as 30:gain_drift.gain=-0.06; repeatable")  # fmt: skip
    add("--first", type=int, default=0, metavar="SEQ", help="number of the first sample (%(default)s)")
    add("--slew", type=float, default=math.inf, metavar="V/S", help="slew limit of the stage, V/s (none)")
    add("--lock-step", type=float, default=0.0, metavar="S",
        help="let the clock stand still until a voltage comes, for at most so long, s (0: it never waits)")  # fmt: skip
    add("--examples", type=Path, metavar="DIR", help="write the files that the examples of --help name, and exit")
    add("--inject", action="store_true", help="accept faults by command, for tests of the listeners (docs/stage.md)")
    add_shared(parser, "zenoh-config", "key", wait={"default": 10.0}, json={"help": "print the ready line as JSON too"})


def parse_change(text: str) -> ParameterChange:
    """``"30:gain_drift.gain=-0.06,resonance.payload_ratio=1"`` as (30.0, {...}). Raises InputError."""
    time_text, _, rest = text.partition(":")
    values: dict[str, float] = {}
    try:
        t_s = float(time_text)
        for part in rest.split(","):
            name, equals, value = part.partition("=")
            if not (name.strip() and equals):
                raise ValueError
            values[name.strip()] = float(value)
    except ValueError:
        raise FieldError("--change", repr(text), "T:NAME=VALUE[,NAME=VALUE], T in s") from None
    return t_s, values


def stage_config(args: argparse.Namespace) -> StageConfig:
    """The stage that the options describe. Raises InputError."""
    if args.file is not None:
        from dehyst.sim.stage.file import load_stage

        config = load_stage(args.file)
    else:
        from dehyst.sim.stage.presets import preset

        config = preset(args.preset)
    if args.rate is not None:
        check_number("--rate", args.rate, "Hz", low=0, above=True)
        config = replace(config, dt_s=1.0 / args.rate)
    if args.seed is not None:
        config = replace(config, seed=args.seed)
    if args.change:
        config = replace(config, changes=(*config.changes, *(parse_change(text) for text in args.change)))
    return config


def run(args: argparse.Namespace) -> int:
    """Run the stage until its end, Ctrl-C or SIGTERM. Returns 0."""
    if args.examples is not None:
        return write_example_files(args.examples)
    from dehyst.service.runtime.session import open_client, open_service
    from dehyst.service.security.access import check_reach
    from dehyst.service.stage_node.node import NodeConfig, StageNode

    stop = StopSignal(raising=True)
    config = stage_config(args)
    check_number("--duration", args.duration, "s", low=0, above=True)
    twins = [name.strip() for name in args.twins.split(",") if name.strip()]
    node_config = NodeConfig(
        stage=config,
        name=args.name,
        units=(args.axis, *twins),
        batch=args.batch,
        ticks=None if args.duration is None else max(1, round(args.duration / config.dt_s)),
        free_run=args.free_run,
        second=args.axis2,
        inject=args.inject,
        first=args.first,
        slew_V_per_s=args.slew,
        lock_step_s=args.lock_step,
    )
    endpoint = check_endpoint(
        "--listen" if args.listen else "--endpoint", args.listen or args.endpoint or DEFAULT_ENDPOINT
    )
    # Switch threads more often than the default 5 ms: the loop must not wait that long for the interpreter.
    sys.setswitchinterval(5e-4)
    if args.listen:
        check_reach("stage", [endpoint], [], args.zenoh_config)
        session = open_service([endpoint], zenoh_config=args.zenoh_config)
    else:
        session = open_client(endpoint, args.wait, args.zenoh_config)
    try:
        node = StageNode(node_config, session)
        # Before the ready line nothing has been moved: a signal until now ends the run without a summary.
        stop.look()
        stop.then(node.stop)
        names = [name for name in (*node_config.units, args.axis2) if name]
        ready = {"ready": True, "stage": args.name, "axes": names, "endpoint": endpoint}
        begins = "running" if args.free_run else "waiting for commands"
        text = f"ready: stage {args.name}, axes {', '.join(names)}, {1 / config.dt_s:g} Hz, {begins}"
        print(json.dumps(ready) if args.json else f"{text} at {endpoint}", flush=True)
        summary = node.run()
    finally:
        session.close()  # type: ignore[no-untyped-call]
    print(json.dumps(summary), flush=True)
    return 0


def write_example_files(folder: Path) -> int:
    """Write them and print what is what. Returns 0. Raises InputError where the folder cannot be written to."""
    from dehyst.service.stage_node.example_files import FILES, write_examples

    try:
        write_examples(folder)
    except OSError as error:
        raise FieldError("--examples", f"{folder}: {error}", "a folder that can be written to") from error
    print(*(f"{name:<16}{text}" for name, text in FILES.items()), sep="\n")
    return 0
