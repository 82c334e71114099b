"""A test bench of processes on loopback, which the demonstration, the soak and the benchmarks share.

`Rig` starts router, service, stage, viewer, echo and paced loop, and stops them when its block ends. `identify_stage`
identifies the models that a service needs, and `write_service_config` writes its configuration file.
"""

from dehyst.lab.testbed.identified_stage import READY, READY_S, SAMPLES_PER_MESSAGE, Rig
from dehyst.lab.testbed.processes import Child, Children, free_port

__all__ = ["READY", "READY_S", "SAMPLES_PER_MESSAGE", "Child", "Children", "Rig", "free_port"]
