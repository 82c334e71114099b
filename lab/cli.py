"""The command ``dehyst``: the commands of the service, and the experiments."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Final

from dehyst.service.cli.main import COMMANDS as SERVICE_COMMANDS
from dehyst.service.cli.main import EXPERIMENTS, LAB, VIEWER, Command
from dehyst.service.cli.main import main as run


def _experiment(module: str, help_line: str, *extras: str) -> Command:
    return Command(f"dehyst.lab.commands.{module}", EXPERIMENTS, help_line, (LAB, *extras), compiles=True)


COMMANDS: Final[dict[str, Command]] = {
    **SERVICE_COMMANDS,
    "demo": _experiment("demo", "watch a simulated stage lose its hysteresis, drift, and be corrected again", VIEWER),
    "rehearse": _experiment("rehearse", "try the service on your own simulated stage, with disturbances"),
    "scenarios": _experiment("scenarios", "compare adapting with not adapting in every kind of drift"),
    "soak": _experiment("soak", "run all processes under a seeded schedule of faults, and check what must hold"),
    "bench": _experiment("bench", "measure the solver's speed and accuracy, from a checkout"),
    "reproduce": _experiment("reproduce", "compute the chapter's tables, beside its own numbers"),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command. Returns its exit status: 0 done, 1 failed on the way, 2 usage error, 130 interrupted."""
    return run(argv, COMMANDS)


if __name__ == "__main__":
    sys.exit(main())
