"""A simulated stage as a process: it takes voltages by sequence number and publishes samples in real time."""
