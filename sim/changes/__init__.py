"""What has changed in a stage since a model of it was good: the error of the frozen model, explained by causes."""

from sim.changes.compare import Comparison, FoundChange, compare
from sim.changes.regression import TooFewSamples
from sim.changes.signatures import Stretch

__all__ = ["Comparison", "FoundChange", "Stretch", "TooFewSamples", "compare"]
