"""The simulated stage, its effects and signals, recordings, and the diagnosis of measured data."""
