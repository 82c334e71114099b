"""The search for causes, and the held-out error by which it decides."""

from dehyst.sim.diagnosis.search.held_out import HeldOut, held_out
from dehyst.sim.diagnosis.search.search import Search, Thresholds, review

__all__ = ["HeldOut", "Search", "Thresholds", "held_out", "review"]
