"""Min-max normalisation of features and targets, (2.42), with its inverse."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adaptive.errors import InputError
from adaptive.types import FloatArray, StateDict


@dataclass(frozen=True, slots=True)
class MinMaxScaling:
    """x_n = (x - low) / (high - low), per column; physical units outside, dimensionless inside.

    Attributes
    ----------
    low, high : (d,) the values that map to 0 and 1, in the columns' own units; ``high > low``.
    """

    low: FloatArray
    high: FloatArray

    def __post_init__(self) -> None:
        low = np.atleast_1d(np.asarray(self.low, dtype=np.float64))
        high = np.atleast_1d(np.asarray(self.high, dtype=np.float64))
        if low.ndim != 1 or low.shape != high.shape:
            raise InputError(f"scaling: low {low.shape} and high {high.shape} must be vectors of one length")
        if not (np.all(np.isfinite(low)) and np.all(np.isfinite(high)) and np.all(high > low)):
            raise InputError(
                f"scaling: got low {low.tolist()}, high {high.tolist()}, expected finite low < high in every column; "
                "a constant feature carries no information, leave it out"
            )
        object.__setattr__(self, "low", low)
        object.__setattr__(self, "high", high)

    @classmethod
    def fit(cls, data: FloatArray, margin: float = 0.0) -> MinMaxScaling:
        """From samples (N, d) or (N,): minimum and maximum, (2.42), widened by ``margin`` of the range each way."""
        table = np.asarray(data, dtype=np.float64)
        table = table[:, None] if table.ndim == 1 else table
        if table.ndim != 2 or table.shape[0] == 0 or not np.all(np.isfinite(table)):
            raise InputError(f"data: got shape {table.shape}, expected (N, d) finite samples, N >= 1; drop the others")
        low, high = table.min(axis=0), table.max(axis=0)
        widen = margin * (high - low)
        return cls(low - widen, high + widen)

    @property
    def dimension(self) -> int:
        """Number of columns d."""
        return int(self.low.size)

    @property
    def span(self) -> FloatArray:
        """high - low, (d,), in the columns' own units."""
        return self.high - self.low

    def normalise(self, x: FloatArray) -> FloatArray:
        """(N, d), (d,) or, for one column, (N,): the same shape, dimensionless, not clipped."""
        return np.asarray((x - self._fit_to(x, self.low)) / self._fit_to(x, self.span), dtype=np.float64)

    def denormalise(self, x: FloatArray) -> FloatArray:
        """The inverse of ``normalise``."""
        return np.asarray(self._fit_to(x, self.low) + x * self._fit_to(x, self.span), dtype=np.float64)

    def state_dict(self) -> StateDict:
        """Two arrays; ``from_state`` builds an equal scaling."""
        return {"low": self.low.copy(), "high": self.high.copy()}

    @classmethod
    def from_state(cls, state: StateDict) -> MinMaxScaling:
        return cls(np.asarray(state["low"], dtype=np.float64), np.asarray(state["high"], dtype=np.float64))

    def _fit_to(self, x: FloatArray, row: FloatArray) -> FloatArray | float:
        shape = np.shape(x)
        if self.dimension == 1 and (not shape or shape[-1] != 1 or len(shape) == 1):
            return float(row[0])
        if not shape or shape[-1] != self.dimension:
            raise InputError(
                f"x: got shape {shape}, expected {self.dimension} columns, those the scaling was fitted on"
            )
        return row
