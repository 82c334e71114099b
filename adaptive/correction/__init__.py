"""Corrections on top of the feedforward by fresh readings: an integral, and what motion that repeats teaches."""
