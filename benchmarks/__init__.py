"""Benchmarks of the solver; run by ``dehyst bench`` from a checkout. Not installed."""
