"""The commands of the experiments. Each module has ``add_arguments(parser)`` and ``run(args) -> int``, the status."""
