"""The command line of the service; `lab.cli` is the whole of ``dehyst``."""
