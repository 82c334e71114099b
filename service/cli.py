"""The command line: one table of commands, each a module of `service.commands`, imported only when asked for."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from collections.abc import Sequence

from adaptive.errors import DehystError

#: name -> one line of help. The module is service.commands.NAME with add_arguments(parser) and run(args) -> int.
COMMANDS: dict[str, str] = {
    "demo": "watch a simulated stage lose its hysteresis, drift, and be caught again",
    "identify": "identify the inverse models of a stage from a recording",
    "serve": "serve and keep learning the inverse models of a stage over zenoh",
    "diagnose": "name what a recording holds that the simulation lacks, and measure the gain",
    "stage": "run a simulated stage as a process on zenoh",
    "query": "ask a running service for voltages",
    "replay": "run the learner over a recording, offline, and see what its gates and its errors do",
    "scenarios": "drift of every kind, adapting against not adapting, with a table and pictures",
    "rehearse": "try the service on a simulated stage of your own, and see what happens when something happens",
    "soak": "run everything under a seeded plan of faults, and judge what must hold",
    "bench": "the solver's speed and accuracy beside its yardsticks and peers, from a checkout",
    "reproduce": "the chapter's tables and figures, computed anew beside its own numbers",
    "status": "a live table of all axes and instances that serve",
    "freeze": "stop an axis from learning, until it is thawed",
    "thaw": "let a frozen axis learn again",
    "rollback": "set the model of an axis back to a checkpoint",
    "checkpoints": "list the checkpoints of an axis",
    "select": "choose the model that answers where a query names none",
    "retune": "search the learning model's settings anew, in the background",
    "ask-diagnosis": "let a running service diagnose its recent samples, in the background",
    "access": "make the certificates, passwords and rules for more than one machine",
    "router": "pass messages on between stages, services and clients on several hosts",
    "view": "stream a running service to the Rerun viewer or into an .rrd file",
}

#: Commands that share a module: the operator's verbs differ in their name and one argument.
MODULES: dict[str, str] = {
    verb: "operate" for verb in ("freeze", "thaw", "rollback", "checkpoints", "select", "retune", "ask-diagnosis")
}


def main(argv: Sequence[str] | None = None) -> int:
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
    for name, line in COMMANDS.items():
        command = sub.add_parser(name, help=line, description=line[0].upper() + line[1:] + ".")
        if name == chosen:
            module = importlib.import_module(f"service.commands.{MODULES.get(name, name)}")
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
