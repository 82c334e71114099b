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
    "bench": "the solver's speed and accuracy beside its yardsticks and peers, from a checkout",
    "reproduce": "the chapter's tables and figures, computed anew beside its own numbers",
    "view": "stream a running service to the Rerun viewer or into an .rrd file",
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
            module = importlib.import_module(f"service.commands.{name}")
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
