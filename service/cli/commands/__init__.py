"""The commands of the service. Each module has ``add_arguments(parser)`` and ``run(args) -> int``, the exit status."""
