"""The command ``dehyst``: what the service offers, and the experiments on it."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Final

from service.cli.main import COMMANDS as SERVICE_COMMANDS
from service.cli.main import Command
from service.cli.main import main as run

COMMANDS: Final[dict[str, Command]] = {
    "demo": Command("lab.commands.demo", "watch a simulated stage lose its hysteresis, drift, and be caught again"),
    **SERVICE_COMMANDS,
    "rehearse": Command(
        "lab.commands.rehearse",
        "try the service on a simulated stage of your own, and see what happens when something happens",
    ),
    "scenarios": Command(
        "lab.commands.scenarios", "drift of every kind, adapting against not adapting, with a table and pictures"
    ),
    "soak": Command("lab.commands.soak", "run everything under a seeded plan of faults, and judge what must hold"),
    "bench": Command(
        "lab.commands.bench", "the solver's speed and accuracy beside its yardsticks and peers, from a checkout"
    ),
    "reproduce": Command(
        "lab.commands.reproduce", "the chapter's tables and figures, computed anew beside its own numbers"
    ),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command. Returns its exit status: 0 done, 1 failed on the way, 2 asked wrongly, 130 interrupted."""
    return run(argv, COMMANDS)


if __name__ == "__main__":
    sys.exit(main())
