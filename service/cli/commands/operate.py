"""The operator's commands: freeze, thaw, rollback, checkpoints, select, retune, ask-diagnosis.

The service records who commanded what, when, and from which sample on it took effect. Where other machines can reach
the service, zenoh's access control decides what an operator may do (docs/access.md, docs/operating.md).
"""

from __future__ import annotations

import argparse
import getpass
import json
import time
from typing import Any, Final

from dehyst.service.cli.options import add_connection, add_shared
from dehyst.service.operating.remote import operate
from dehyst.service.protocol.keys import Keys
from dehyst.service.runtime.session import open_client

_EXAMPLES: Final = {
    "freeze": "  dehyst freeze --axis x --who alice\n",
    "thaw": "  dehyst thaw --axis x --who alice\n",
    "rollback": "  dehyst checkpoints --axis x\n  dehyst rollback 41 --axis x    # a number of that list\n",
    "checkpoints": "  dehyst checkpoints --axis x\n",
    "select": "  dehyst select linear --axis x\n  dehyst select auto --axis x\n",
    "retune": "  dehyst retune --axis x\n",
    "ask-diagnosis": "  dehyst ask-diagnosis --axis x --recent 30\n",
}


#: Verbs that a fleet takes too, for the axes that are named.
_OF_FLEETS: Final = ("freeze", "thaw", "rollback")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command that the parser is named after, with units in the help."""
    verb = parser.prog.split()[-1]
    parser.epilog = f"{parser.epilog}\n{_EXAMPLES[verb]}"
    parser.set_defaults(verb=verb)
    add = parser.add_argument
    if verb == "rollback":
        add("checkpoint", type=int, nargs="?", help="number of a checkpoint, from 'dehyst checkpoints'")
    elif verb == "select":
        add("model", help="name of a model of the axis, such as lssvm_adaptive or linear")
    elif verb == "ask-diagnosis":
        add("--recent", type=float, metavar="S", help="length of the newest samples to diagnose, s")
        add("--report", action="store_true", help="also write a report with pictures")
    add_shared(parser, "stage", "axis")
    if verb in _OF_FLEETS:
        add("--axes", type=int, nargs="+", metavar="K", help="axes of a fleet: --axis fleet --axes 3 17")
    add_connection(parser, timeout_s=5.0)
    add("--who", metavar="NAME", help="operator, for the event log (the login name)")
    add_shared(parser, json={"help": "print the answer as JSON"})


def run(args: argparse.Namespace) -> int:
    """Send the command and print the answer. Returns 0. Raises RefusedError with the service's message."""
    keys = Keys(args.stage, args.axis)
    verb = {"ask-diagnosis": "diagnose"}.get(args.verb, args.verb)
    with open_client(args.endpoint, args.wait, args.zenoh_config) as session:
        answer = operate(session, keys, verb, args.who or _login(), _arguments(args), args.timeout)
    if args.json:
        print(json.dumps(answer))
    elif verb == "checkpoints":
        _print_checkpoints(answer["result"]["checkpoints"])
    else:
        told = ", ".join(f"{name} {value}" for name, value in answer["result"].items())
        print(f"{keys.stage}/{keys.axis}: {verb} from sample {answer['seq']} on{'; ' + told if told else ''}")
    return 0


def _arguments(args: argparse.Namespace) -> dict[str, Any]:
    if args.verb in _OF_FLEETS and args.axes is not None:
        return {"axes": args.axes}
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
        print("no checkpoints: set a folder for them in the service's configuration, and wait a moment")
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
