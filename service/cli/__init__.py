"""The command line of the service: ``python -m dehyst.service.cli``. `lab.cli` adds the experiments and is ``dehyst``.

`service.cli.main` has the table of commands, `service.cli.options` the options that several commands share, and
`service.cli.commands` one module for each command.
"""

__all__ = ["commands", "main", "options"]
