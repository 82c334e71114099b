"""The operator's verbs, one command each: freeze, thaw, rollback, checkpoints, select, retune, ask-diagnosis."""

from __future__ import annotations

import argparse
import getpass
import json
import time
from pathlib import Path
from typing import Any

from service.operating.remote import operate
from service.protocol.keys import Keys
from service.runtime.session import DEFAULT_ENDPOINT, open_client

EPILOG = """\
The service writes down who commanded what, when, and from which sample on it held. What an operator may do is decided
by zenoh's access control where the service is open to other machines (docs/access.md, docs/operating.md).
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the verb that the parser is named after; units stand in the help."""
    verb = parser.prog.split()[-1]
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = EPILOG
    parser.set_defaults(verb=verb)
    add = parser.add_argument
    if verb == "rollback":
        add("checkpoint", type=int, help="number of a checkpoint, from 'dehyst checkpoints'")
    elif verb == "select":
        add("model", help="name of a model of the axis, such as lssvm_adaptive or linear")
    elif verb == "ask-diagnosis":
        add("--recent", type=float, metavar="S", help="how much of the newest samples to look at, s")
        add("--report", action="store_true", help="write a report with pictures as well")
    add("--stage", default="demo", help="stage on the wire (%(default)s)")
    add("--axis", default="x", help="axis of the stage (%(default)s)")
    add("--endpoint", default=DEFAULT_ENDPOINT, help="zenoh endpoint of the service or router (%(default)s)")
    add("--who", help="who commands, for the journal (the login name)")
    add("--timeout", type=float, default=5.0, metavar="S", help="longest wait for the answer, s (%(default)s)")
    add("--wait", type=float, default=0.0, metavar="S", help="how long to wait for the service to come up, s (0)")
    add("--zenoh-config", type=Path, metavar="FILE", help="zenoh's own configuration, for TLS and passwords")
    add("--json", action="store_true", help="print the answer as JSON")


def run(args: argparse.Namespace) -> int:
    """Command, and print the answer. Returns 0; refusals are raised in the service's own words."""
    keys = Keys(args.stage, args.axis)
    verb = {"ask-diagnosis": "diagnose"}.get(args.verb, args.verb)
    session = open_client(args.endpoint, args.wait, args.zenoh_config)
    try:
        answer = operate(session, keys, verb, args.who or _login(), _arguments(args), args.timeout)
    finally:
        session.close()  # type: ignore[no-untyped-call]
    if args.json:
        print(json.dumps(answer))
    elif verb == "checkpoints":
        _print_checkpoints(answer["result"]["checkpoints"])
    else:
        told = ", ".join(f"{name} {value}" for name, value in answer["result"].items())
        print(f"{keys.stage}/{keys.axis}: {verb} from sample {answer['seq']} on{'; ' + told if told else ''}")
    return 0


def _arguments(args: argparse.Namespace) -> dict[str, Any]:
    if args.verb == "rollback":
        return {"checkpoint": args.checkpoint}
    if args.verb == "select":
        return {"model": args.model}
    if args.verb == "ask-diagnosis":
        recent = {} if args.recent is None else {"recent_s": args.recent}
        return recent | ({"report": True} if args.report else {})
    return {}


def _print_checkpoints(checkpoints: list[dict[str, Any]]) -> None:
    if not checkpoints:
        print("no checkpoints: name a folder for them in the service's configuration, and give it a moment")
        return
    print(f"{'checkpoint':>12} {'sample':>12} {'learnt':>12} {'size kB':>9}  made")
    for entry in checkpoints:
        made = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(float(entry["time_unix_s"])))
        size_kb = entry["bytes"] / 1000
        print(f"{entry['checkpoint']:>12} {entry['seq']:>12} {entry['samples']:>12} {size_kb:>9.0f}  {made}")


def _login() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return "unknown"
