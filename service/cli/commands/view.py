"""``dehyst view``: stream a running service to the Rerun viewer or into an .rrd file.

What is drawn, and where in a file: docs/viewer.md.

  dehyst view --spawn                           # a viewer on this machine
  dehyst view --web                             # a page for a browser on this machine, without a display here
  dehyst view --rrd run.rrd --duration 5        # a file, for later: rerun run.rrd
"""

from __future__ import annotations

import argparse
import json
import logging
import subprocess
import uuid
from pathlib import Path
from typing import Any

from dehyst.adaptive.errors import InputError
from dehyst.service.cli.options import add_connection, add_shared
from dehyst.service.protocol.errors import ServiceError
from dehyst.service.runtime.session import open_client
from dehyst.service.runtime.stopping import StopSignal
from dehyst.service.viewer.consumer import Consumer, ConsumerConfig
from dehyst.service.viewer.output import Output, OutputConfig
from dehyst.service.viewer.records import SceneConfig

log = logging.getLogger("dehyst.view")

DEFAULT_URL = "rerun+http://127.0.0.1:9876/proxy"
#: Past that live plots show by default, s; a file shows all.
LIVE_HISTORY_S = 30.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command, with units in the help."""
    add = parser.add_argument
    add_connection(parser, wait_s=10.0, timeout_s=None)
    add_shared(parser, "stage", axis={"help": "axis that the service serves and learns from (%(default)s)"})
    add("--model", default="lssvm_adaptive", help="model that steers the axis; names its curves (%(default)s)")
    many: dict[str, Any] = {"action": "append", "default": []}
    add("--twin", **many, metavar="NAME=MODEL", help="another axis, steered by MODEL, to compare with; repeatable")
    add("--change-at", **many, type=float, metavar="S", help="mark a change of the stage at this time, s; repeatable")
    add("--rrd", type=Path, metavar="FILE", help="write an .rrd, overwriting FILE")
    at = f"stream to a viewer that already runs (at {DEFAULT_URL} without URL)"
    add("--connect", nargs="?", const=DEFAULT_URL, metavar="URL", help=at)
    add("--spawn", action="store_true", help="start a viewer on this machine and stream to it; it stays open")
    add("--web", action="store_true", help="serve Rerun's web viewer and stream to it; ends with this command")
    add("--port", type=int, default=9876, help="port of the started viewer, loopback only (%(default)s)")
    add("--web-port", type=int, default=9090, help="port of the page of --web, loopback only (%(default)s)")
    add("--range-um", type=float, metavar="UM", help="range for percentages, µm (span of the reference so far)")
    past = f"past that the plots show, s; 0 for all (all in a file, {LIVE_HISTORY_S:g} live)"
    add("--history", type=float, metavar="S", help=past)
    add("--batch", type=float, default=0.2, metavar="S", help="period of sending, s, 0.05 to 5 (%(default)s)")
    add_shared(parser, "duration", json={"help": "print the counts at the end as JSON"})


def run(args: argparse.Namespace) -> int:
    """Stream until a signal, the end of the viewer or of the duration. Returns 0, or 1 if the file is incomplete."""
    live = [name for name in ("connect", "spawn", "web") if getattr(args, name)]
    if not (args.rrd or live):
        raise InputError("rrd, connect, spawn, web: got none of them, expected at least one; --rrd FILE writes a file")
    if len(live) > 1:
        raise InputError(
            f"{', '.join(live)}: got {len(live)} of them, expected one: --spawn and --web start what they stream to"
        )
    config = ConsumerConfig(
        args.stage, args.axis, args.model, twins(args.twin), changes_s=tuple(args.change_at), batch_s=args.batch
    )
    # Before anything slow: a signal may come at once.
    stop = StopSignal()
    outputs: list[Output] = []
    viewer: subprocess.Popen[bytes] | None = None
    try:
        with open_client(args.endpoint, args.wait, args.zenoh_config) as session:
            url, name = args.connect, str(uuid.uuid4())
            if args.spawn or args.web:
                from dehyst.service.viewer.rerun_sink import page_of, spawn_viewer

                viewer, url = spawn_viewer(args.port, web_port=args.web_port if args.web else None)
                if args.web:
                    print(f"open in a browser: {page_of(url, args.web_port)}", flush=True)
            for rrd, connect in ((args.rrd, None), (None, url)):
                past_s = LIVE_HISTORY_S if connect and args.history is None else args.history or None
                scene = SceneConfig(f"{args.stage}/{args.axis}", config.models, args.range_um, history_s=past_s)
                if rrd or connect:
                    outputs.append(Output(OutputConfig(scene, rrd, connect, name)))
            consumer = Consumer(session, config, outputs)
            try:
                where = " and ".join(output.config.name for output in outputs)
                print(f"viewing {args.stage}/{args.axis} at {args.endpoint} into {where}", flush=True)
                _wait(stop, args.duration, viewer, alone=args.rrd is None)
            finally:
                consumer.close()
    finally:
        # A file gets all the time that a slow disk may need; a viewer may be gone.
        cut_off = [output.config for output in outputs if not output.close(60.0 if output.config.rrd else 5.0)]
        if args.web and viewer is not None:
            viewer.terminate()
            viewer.wait(5.0)
    counts = dict(consumer.counts)
    if args.json:
        print(json.dumps({"schema": 1, "complete": not cut_off, "counts": counts}), flush=True)
    else:
        lost = counts.get("dropped_batches", 0)
        print(f"{counts.get('samples', 0)} samples drawn, {lost} batches dropped", flush=True)
        if args.rrd:
            print(f"open it with: rerun {args.rrd}", flush=True)
    for output_config in cut_off:
        log.warning("%s is incomplete: it did not take everything before the end", output_config.name)
    return 1 if any(output_config.rrd for output_config in cut_off) else 0


def twins(given: list[str]) -> tuple[tuple[str, str], ...]:
    """``NAME=MODEL`` pairs. Raises InputError naming the one that is not a pair."""
    pairs = [text.partition("=") for text in given]
    for text, (axis, _, model) in zip(given, pairs, strict=True):
        if not (axis and model):
            raise InputError(f"twin: got {text!r}, expected NAME=MODEL such as x_linear=linear")
    return tuple((axis, model) for axis, _, model in pairs)


def _wait(stop: StopSignal, duration_s: float | None, viewer: subprocess.Popen[bytes] | None, alone: bool) -> None:
    """Wait for a signal, the end of the time, or the end of the spawned viewer where there is no file (``alone``)."""
    for _ in stop.every(0.1, duration_s):
        ended = None if viewer is None else viewer.poll()
        if ended:
            raise ServiceError(
                f"the viewer ended with status {ended}: is there a display and a graphics driver, and is its port "
                "free? --web needs no display, --rrd FILE needs neither"
            )
        if ended == 0 and alone:
            return
