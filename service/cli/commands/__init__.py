"""The commands of the service.

Each module is one command with ``add_arguments(parser)`` and ``run(args) -> int``, the exit status; its docstring is
the text below its help. The command line imports only the module of the command that it runs.
"""

from __future__ import annotations

__all__: list[str] = []
