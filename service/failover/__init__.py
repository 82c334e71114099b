"""Failover of an axis: one instance serves, standbys hold the same model, and one of them takes over if it fails.

`role_control` decides the role of an instance, `standby_model` keeps the model of a standby equal to the served one and
reads what the other instance has left on the disk, `state_transfer` is what instances ask each other.
"""
