"""Online least squares with forgetting and lower bounds on the weights, for models that are linear in them.

The normal matrix of all samples, in which each new sample scales the older ones by one factor, is the exact recursive
least-squares problem in information form. Unlike the covariance form it admits bounds on the weights and cannot wind
up. It starts from samples that the identified model generates over its own range, so learning begins at the
identified weights and leaves them as real samples arrive. Only samples that teach age the older ones; a stage at rest
forgets nothing.
"""

from __future__ import annotations

from abc import abstractmethod
from collections import deque
from dataclasses import asdict, dataclass

import numpy as np

from adaptive.compiled import compiled
from adaptive.errors import InputError
from adaptive.online.gates import LEARNT, NUMERICS, PASSED, SETTLING, UNEXCITED
from adaptive.types import FloatArray, StateDict, prefixed, under
from baselines.bounded_least_squares import bounded_minimum
from baselines.online_baseline import OnlineBaseline, field_of

#: The velocity is a difference over this many samples on each side.
_HALF = 2


@dataclass(frozen=True, slots=True)
class LeastSquaresConfig:
    """How fast the least-squares baselines learn.

    Attributes
    ----------
    learn_every : samples between two that may teach; at least 5.
    solve_every : samples that teach between two solutions.
    remember : samples that teach after which the weight of one has fallen to 1/e.
    trust : number of samples that the identified model counts for.
    excitation : share of the voltage range by which u must have moved for a sample to teach.
    settle : samples after a start or a gap that do not teach.

    Raises InputError on a value out of range.
    """

    learn_every: int = 10
    solve_every: int = 10
    remember: float = 300.0
    trust: float = 200.0
    excitation: float = 0.002
    settle: int = 50

    def __post_init__(self) -> None:
        if self.learn_every < 2 * _HALF + 1 or self.solve_every < 1:
            raise InputError(
                f"learn_every, solve_every: got {self.learn_every}, {self.solve_every}, expected at least 5 and 1"
            )
        if not (self.remember >= 10.0 and self.trust > 0.0 and self.excitation >= 0.0 and self.settle >= 0):
            raise InputError(f"remember, trust, excitation, settle: got {self!r}, expected >= 10, > 0, >= 0, >= 0")


@compiled
def forget_and_add(normal: FloatArray, row: FloatArray, keep: float) -> None:
    """normal <- keep normal + row row', (p, p) in place; the result is exactly symmetric."""
    for i in range(row.size):
        for j in range(i, row.size):
            value = keep * normal[i, j] + row[i] * row[j]
            normal[i, j] = value
            normal[j, i] = value


class LeastSquaresOnline(OnlineBaseline):
    """Recursive least squares with one row [regressors, target] per sample that teaches.

    A model implements how a row is made, what its residual is, and how the normal matrix is solved.

    Parameters
    ----------
    u_range_V : voltage range, which the excitation refers to, V.
    rows : (n, p) rows of the identified model, from which learning starts.
    """

    def __init__(self, dt_s: float, u_range_V: float, config: LeastSquaresConfig, rows: FloatArray) -> None:
        super().__init__(dt_s, config.settle)
        self.config = config
        self._step_V = config.excitation * u_range_V
        self._keep = 1.0 - 1.0 / config.remember
        self._normal = (rows.T @ rows) * (config.trust / rows.shape[0])
        self._recent: deque[tuple[float, float]] = deque(maxlen=2 * _HALF + 1)
        self._taught_u = np.inf
        self._pending = np.empty(0)

    def _restart(self, u_V: float, y_um: float, first: bool) -> None:
        self._recent.clear()
        self._recent.append((u_V, y_um))
        self._step_memory(u_V, first)

    def _advance(self, u_V: float, y_um: float, settled: bool) -> str:
        self._step_memory(u_V, False)
        self._recent.append((u_V, y_um))
        phase = self._since_start % self.config.learn_every
        if phase == 0:
            self._pending = self._regressors_now()
        if not settled:
            return SETTLING
        if phase != _HALF or len(self._recent) <= 2 * _HALF:
            return PASSED
        u, y = self._recent[_HALF]
        if abs(u - self._taught_u) < self._step_V:
            return UNEXCITED
        speed = (self._recent[-1][1] - self._recent[0][1]) / (2.0 * _HALF * self._dt)
        self._taught_u = u
        row = self._row(self._pending, y, speed)
        forget_and_add(self._normal, row, self._keep)
        residual = self._residual(row)
        self._square += (residual * residual - self._square) / self.config.remember
        if (self._counters[LEARNT] + 1) % self.config.solve_every == 0 and not self._solve():
            return NUMERICS
        return LEARNT

    def _step_memory(self, u_V: float, first: bool) -> None:
        """Advance the model's memory of the voltage."""

    @abstractmethod
    def _regressors_now(self) -> FloatArray:
        """The part of a row that depends on the voltage, at this instant."""

    @abstractmethod
    def _row(self, pending: FloatArray, y_um: float, v_um_per_s: float) -> FloatArray:
        """The row of the voltage part ``pending`` and of displacement and speed at the same instant."""

    @abstractmethod
    def _residual(self, row: FloatArray) -> float:
        """Residual of a row with the present weights, µm."""

    @abstractmethod
    def _solve(self) -> bool:
        """Solve the normal matrix for new weights. Returns False, and changes nothing, where that fails."""

    @staticmethod
    def _minimum(normal: FloatArray, lower: FloatArray) -> FloatArray:
        """Weights (p,) not below ``lower`` (p,); the target is the last row and column of ``normal`` (p + 1, p + 1).

        Raises RuntimeError where the matrix is not positive definite.
        """
        matrix = normal[:-1, :-1] + 1e-12 * np.diag(normal).max() * np.eye(lower.size)
        return bounded_minimum(matrix, normal[:-1, -1], lower)

    def _learning_state(self) -> StateDict:
        return {
            **self._common_state(),
            **prefixed("config_", asdict(self.config)),
            "normal": self._normal.copy(),
            "recent": np.array(list(self._recent), dtype=np.float64).reshape(-1, 2),
            "taught_u_V": float(self._taught_u) if np.isfinite(self._taught_u) else None,
            "pending": self._pending.copy(),
        }

    def _restore_learning(self, state: StateDict) -> None:
        self._restore_common(state)
        self._normal = np.array(state["normal"], dtype=np.float64)
        self._recent.extend((float(u), float(y)) for u, y in np.asarray(state["recent"]).reshape(-1, 2))
        taught = state["taught_u_V"]
        self._taught_u = np.inf if taught is None else float(taught)
        self._pending = np.array(state["pending"], dtype=np.float64)


def config_from(state: StateDict) -> LeastSquaresConfig:
    """The configuration in a stored state. Raises InputError where a field is missing."""
    values = under("config_", state)
    whole = {name: int(field_of(values, name, "online")) for name in ("learn_every", "solve_every", "settle")}
    real = {name: float(field_of(values, name, "online")) for name in ("remember", "trust", "excitation")}
    return LeastSquaresConfig(
        learn_every=whole["learn_every"], solve_every=whole["solve_every"], settle=whole["settle"], **real
    )
