"""Simulated stages: configuration, presets, stage files, stepping, and control of a stage."""
