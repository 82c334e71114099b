"""``dehyst status``: all axes and instances that serve, once or live.

  dehyst status                   # a live table; Ctrl-C ends it
  dehyst status --once --json
  dehyst status --check           # for a watchdog: see the exit status

Exit status of --check: 0 every axis is ok; 1 an axis is not ok but answers as before (frozen, thinned, refusing,
unsure, not learning); 2 usage error; 3 an axis is in trouble, stale or drops samples; 4 no service answers.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import deque
from typing import Any

import zenoh

from dehyst.service.cli import options
from dehyst.service.operating.remote import Standbys, in_order, screen, statuses, table, warnings
from dehyst.service.protocol.container import fields_of
from dehyst.service.protocol.errors import SessionError
from dehyst.service.protocol.keys import ROOT
from dehyst.service.runtime.session import open_client
from dehyst.service.runtime.stopping import StopSignal

#: A little more than the period at which a standby publishes its status, s.
_STANDBY_PERIOD_S = 1.2


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command, with units in the help."""
    add = parser.add_argument
    options.add_connection(parser)
    options.add_selection(parser)
    add("--check", action="store_true", help="print what needs attention, and exit: a health check, see below")
    add("--once", action="store_true", help="print the table once, and exit")
    add("--period", type=float, default=1.0, metavar="S", help="period of the live table, s (%(default)s)")
    options.add_shared(parser, "duration", json={"help": "print JSON: once an object, live one a line"})


def run(args: argparse.Namespace) -> int:
    """Show the table. Returns 0, or 1 where --once finds no service; Ctrl-C ends the live table with 0."""
    options.check_selection(args)
    options.check_number("--period", args.period, "s", low=0.1, high=3600.0)
    try:
        opened = open_client(args.endpoint, args.wait, args.zenoh_config)
    except SessionError as error:
        if not args.check:
            raise
        print(error)
        return 4
    with opened as session:
        standbys = Standbys(session, args.stage, args.axis)
        try:
            if args.check:
                return _check(_settled(session, args))
            if not args.once:
                return _live(session, standbys, args)
            all_answered = time.monotonic() + _STANDBY_PERIOD_S
            found = _settled(session, args)
            time.sleep(max(0.0, all_answered - time.monotonic()))
            found = in_order([*found, *standbys.statuses()])
            print(json.dumps({"schema": 1, "axes": found}) if args.json else table(found))
            return 0 if found else 1
        finally:
            standbys.undeclare()


def _check(found: list[dict[str, Any]]) -> int:
    """Print what needs attention and return the exit status of `CHECK`."""
    if not found:
        print("no service answers")
        return 4
    worst = 0
    for status in found:
        state, reason = str(status.get("state", "unknown")), str(status.get("state_reason", ""))
        if state != "ok":
            # It still answers, safely: a human should look. A wrong sensor or model is more urgent.
            urgent = bool(status.get("trouble")) or state in ("stale", "dropping")
            worst = max(worst, 3 if urgent else 1)
        said = state if state == "ok" else f"{state}: {reason}"
        print(f"{status['stage']}/{status['axis']}: {said}", *warnings(status), sep="\n")
    return worst


def _live(session: zenoh.Session, standbys: Standbys, args: argparse.Namespace) -> int:
    events: deque[str] = deque(maxlen=20)
    subscriber = session.declare_subscriber(
        f"{ROOT}/{args.stage}/{args.axis}/event", lambda sample: events.append(_event(sample))
    )
    on_screen = sys.stdout.isatty() and not args.json

    def show(answers: list[dict[str, Any]]) -> None:
        found = in_order([*answers, *standbys.statuses()])
        if args.json:
            print(json.dumps({"schema": 1, "time_unix_s": time.time(), "axes": found}), flush=True)
        elif on_screen:
            print(screen(found, args.endpoint, list(events)), end="", flush=True)
        else:
            print(f"{table(found)}\n", flush=True)

    # A flag, no exception: an exception that a signal raises inside a finalizer is lost.
    stop = StopSignal()
    try:
        if on_screen:
            print("\x1b[?1049h\x1b[?25l", end="")  # the terminal's alternate screen, without a cursor
        show(_settled(session, args))
        for _ in stop.every(args.period, args.duration):
            show(statuses(session, args.stage, args.axis, args.timeout))
    except BrokenPipeError:
        sys.stdout = None  # the reader has closed the pipe; there is nothing to flush to
    finally:
        subscriber.undeclare()  # type: ignore[no-untyped-call]
        if on_screen:
            print("\x1b[?25h\x1b[?1049l", end="", flush=True)
    return 0


def _settled(session: zenoh.Session, args: argparse.Namespace) -> list[dict[str, Any]]:
    """The first answer. Asks for half a second: a new session does not know the services at once."""
    until = time.monotonic() + 0.5
    while not (found := statuses(session, args.stage, args.axis, args.timeout)) and time.monotonic() < until:
        time.sleep(0.05)
    return found


def _event(sample: zenoh.Sample) -> str:
    data = fields_of(sample.payload.to_bytes())
    try:
        when = time.strftime("%H:%M:%S", time.localtime(float(data["time_unix_s"])))
        return f"{when} {sample.key_expr} {data['event']}: {data['detail']}"
    except (ValueError, KeyError, TypeError, OverflowError, OSError):
        return f"{sample.key_expr}: an event that cannot be read"
