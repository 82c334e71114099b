"""A test bench of processes on loopback, which the demonstration, the soak and the benchmarks share.

`Rig` starts router, service, stage, viewer and echo, and stops them when its block ends. `identify_stage`
identifies the models that a service needs, and `write_service_config` writes its configuration file.
"""
