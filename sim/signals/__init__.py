"""Signals for simulated stages: ``voltages`` to apply, ``references`` to follow."""
