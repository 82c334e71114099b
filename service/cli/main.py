"""The command line of the service: one table of commands. A command's module is imported only when it is asked for."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

from adaptive.errors import DehystError


class Command(NamedTuple):
    """One command: a module with ``add_arguments(parser)`` and ``run(args) -> int``, and one line of help."""

    module: str
    help: str


def _command(module: str, help_line: str) -> Command:
    return Command(f"service.cli.commands.{module}", help_line)


#: The commands that need nothing but the service. `lab.cli` adds those that experiment on it.
COMMANDS: Final[dict[str, Command]] = {
    "identify": _command("identify", "identify the inverse models of a stage from a recording"),
    "serve": _command("serve", "serve and keep learning the inverse models of a stage over zenoh"),
    "diagnose": _command("diagnose", "name what a recording holds that the simulation lacks, and measure the gain"),
    "stage": _command("stage", "run a simulated stage as a process on zenoh"),
    "query": _command("query", "ask a running service for voltages"),
    "replay": _command("replay", "run the learner over a recording, offline, and see what its gates and its errors do"),
    "status": _command("status", "a live table of all axes and instances that serve"),
    "freeze": _command("operate", "stop an axis from learning, until it is thawed"),
    "thaw": _command("operate", "let a frozen axis learn again"),
    "rollback": _command("operate", "set the model of an axis back to a checkpoint"),
    "checkpoints": _command("operate", "list the checkpoints of an axis"),
    "select": _command("operate", "choose the model that answers where a query names none"),
    "retune": _command("operate", "search the learning model's settings anew, in the background"),
    "ask-diagnosis": _command("operate", "let a running service diagnose its recent samples, in the background"),
    "access": _command("access", "make the certificates, passwords and rules for more than one machine"),
    "router": _command("router", "pass messages on between stages, services and clients on several hosts"),
    "view": _command("view", "stream a running service to the Rerun viewer or into an .rrd file"),
}


def main(argv: Sequence[str] | None = None, commands: Mapping[str, Command] = COMMANDS) -> int:
    """Run one command. Returns its exit status: 0 done, 1 failed on the way, 2 asked wrongly, 130 interrupted."""
    args = sys.argv[1:] if argv is None else list(argv)
    # Before numpy is imported: a second BLAS thread makes a solve of 1 ms stall for 65 ms now and then.
    for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    parser = argparse.ArgumentParser(
        prog="dehyst", description="Takes the hysteresis out of piezo stages, and keeps it out."
    )
    sub = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    chosen = next((a for a in args if not a.startswith("-")), None)
    for name, (module_name, line) in commands.items():
        command = sub.add_parser(name, help=line, description=line[0].upper() + line[1:] + ".")
        if name == chosen:
            module = importlib.import_module(module_name)
            module.add_arguments(command)
            command.set_defaults(run=module.run)
    parsed = parser.parse_args(args)
    try:
        return int(parsed.run(parsed))
    except DehystError as error:
        print(f"dehyst {parsed.command}: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"dehyst {parsed.command}: interrupted", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
