"""Models of the causes that a diagnosis may name, and the catalogue of them."""

from sim.diagnosis.causes.catalogue import CAUSE_MODELS, NAMES

__all__ = ["CAUSE_MODELS", "NAMES"]
