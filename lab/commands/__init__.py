"""The commands of the experiments, which ``lab.cli`` adds to those of the service.

Each module is one command with ``add_arguments(parser)`` and ``run(args) -> int``, the exit status. The command line
imports only the module of the command that it runs.
"""

from __future__ import annotations

__all__: list[str] = []
