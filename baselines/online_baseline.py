"""What the online baselines share: admission of raw samples, outcome counters, running error.

Outcomes have the names of ``adaptive.online.gates``, so the service counts the samples of all models alike.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import deque
from dataclasses import asdict, dataclass
from typing import Annotated, Any, ClassVar, Self

import numpy as np

from dehyst.adaptive.compiled import compiled
from dehyst.adaptive.errors import InputError, ModelFileError
from dehyst.adaptive.online.gates import (
    DUPLICATE,
    GAP,
    LEARNT,
    NOT_FINITE,
    NUMERICS,
    OUT_OF_ORDER,
    OUTLIER,
    PASSED,
    SETTLING,
    TIMING,
    UNEXCITED,
)
from dehyst.adaptive.state import Entry, restore, save, within
from dehyst.adaptive.types import (
    FloatArray,
    Hyperparameters,
    InverseModel,
    MovingPart,
    OnlineModel,
    Sample,
    StateDict,
    WindowData,
    prefixed,
    under,
)
from dehyst.baselines.bounded_least_squares import bounded_minimum

REASONS = (NOT_FINITE, DUPLICATE, OUT_OF_ORDER, TIMING, GAP, SETTLING, UNEXCITED, OUTLIER, NUMERICS)
#: Relative error of a time step above which the sample is refused.
_TIMING_TOLERANCE = 0.5
#: Magnitude (µm, V) from which a value is refused as not finite; keeps squares finite.
_LARGEST = 1e9


class OnlineBaseline(ABC):
    """Admission and bookkeeping of one axis; a model derives from it and implements ``_restart`` and ``_advance``.

    Deterministic, bounded in time and memory. Not thread-safe. The abilities of :class:`adaptive.types.OnlineModel`
    that a baseline lacks are implemented here, trivially.

    Parameters
    ----------
    dt_s : sample time, s.
    settle : samples after a start or a gap that do not teach.
    """

    #: Classes of the identified model, whose state and settings the constructor takes, and of the settings.
    BASE: ClassVar[Any]
    CONFIG: ClassVar[Any]

    base: InverseModel
    config: Any
    _seq: Annotated[int, Entry("the last sample handled", low=-1)]
    _t_s: Annotated[float, Entry("its time", "s")]
    _since_start: Annotated[int, Entry("samples since the start or a gap", low=0)]
    _square: Annotated[float, Entry("mean square residual", "µm²", low=0.0, name="square_um2")]
    _counters: Annotated[
        dict[str, int], Entry("samples by outcome", low=0, name="count", among=(LEARNT, PASSED, *REASONS))
    ]

    def __init__(self, dt_s: float, settle: int) -> None:
        self._dt = dt_s
        self._settle = settle
        self._seq = -1
        self._t_s = 0.0
        self._since_start = 0
        self._square = 0.0
        self._counters = dict.fromkeys((LEARNT, PASSED, *REASONS), 0)

    @property
    def seq(self) -> int:
        """Sequence number of the last sample handled, -1 before any."""
        return self._seq

    def counters(self) -> dict[str, int]:
        """Number of samples by outcome, for every outcome."""
        return dict(self._counters)

    def handle(self, sample: Sample) -> str:
        """Take a raw sample. Returns "learnt", "passed" (good, but not due to teach), or the reason of a refusal."""
        outcome = self._refusal(sample)
        if not outcome:
            missing = self._seq >= 0 and sample.seq > self._seq + 1
            first = self._seq < 0
            self._seq, self._t_s = sample.seq, sample.t_s
            if first or missing:
                self._since_start = 0
                self._restart(sample.u_V, sample.y_um, first)
            else:
                self._since_start += 1
            if missing:
                outcome = GAP
            else:
                outcome = self._advance(sample.u_V, sample.y_um, self._since_start >= self._settle)
        self._counters[outcome] += 1
        return outcome

    # ---- abilities that only a learner has

    def resync(self) -> None:
        """Do nothing: ``handle`` restarts by itself after a gap in time or numbers."""

    def take_place_of(self, other: OnlineModel) -> None:
        """Do nothing, as in ``resync``: the position of a baseline is its last sample."""

    def freeze(self) -> None:
        """Do nothing: a competition gives a frozen baseline no samples."""

    def thaw(self) -> None:
        """Do nothing; see ``freeze``."""

    def moving(self) -> MovingPart | None:
        """Always None: its snapshot is small."""
        return None

    def memory_for(self, model: InverseModel, smoothed: bool = False) -> FloatArray | None:
        """None: a baseline tracks no memory of its own."""
        return None

    def window_data(self) -> WindowData | None:
        """None: there are no hyper-parameters to tune."""
        return None

    def adopt(self, hyper: Hyperparameters) -> str:
        """Refuse: there are no hyper-parameters."""
        return "it has no hyper-parameters"

    @property
    def trouble(self) -> str:
        """Always "": a baseline does not judge the sensor."""
        return ""

    @property
    def why(self) -> str:
        """Always ""; see ``trouble``."""
        return ""

    @property
    def distrusts(self) -> bool:
        """Always False; see ``trouble``."""
        return False

    def diagnostics(self) -> dict[str, Any]:
        """Empty."""
        return {}

    def take_events(self) -> list[tuple[str, str]]:
        """Empty."""
        return []

    def warm(self) -> None:
        """Do nothing: the first samples load every step."""

    # ---- inside a sample, and the shared state

    def _refusal(self, sample: Sample) -> str:
        if not (math.isfinite(sample.t_s) and abs(sample.u_V) < _LARGEST and abs(sample.y_um) < _LARGEST):
            return NOT_FINITE
        if self._seq < 0:
            return ""
        if sample.seq == self._seq:
            return DUPLICATE
        if sample.seq < self._seq:
            return OUT_OF_ORDER
        expected = (sample.seq - self._seq) * self._dt
        return TIMING if abs(sample.t_s - self._t_s - expected) > _TIMING_TOLERANCE * expected else ""

    @abstractmethod
    def snapshot(self) -> InverseModel:
        """The present model, immutable."""

    @abstractmethod
    def _restart(self, u_V: float, y_um: float, first: bool) -> None:
        """Begin at the first sample or after a gap, where the time since the sample before is not one step."""

    @abstractmethod
    def _advance(self, u_V: float, y_um: float, settled: bool) -> str:
        """Take a good sample one step after the last. Returns the outcome. ``settled``: it may teach."""

    # ---- keeping

    @property
    def sizes(self) -> dict[str, int]:
        """Names of the dimensions of the state."""
        return {}

    @property
    def given(self) -> dict[str, Any]:
        """What the records of a stored state do not hold themselves; see `adaptive.state.load`."""
        return {}

    def check_state(self, values: dict[str, Any]) -> None:
        """Raise ValueError where new values of the state do not fit what this baseline was made with."""

    def state_dict(self) -> StateDict:
        """The whole state, the identified model and the settings; ``from_state`` continues to the same last bit."""
        settings = {
            name: np.array(value) if isinstance(value, tuple) else value for name, value in asdict(self.config).items()
        }
        return save(self) | prefixed("config.", settings) | prefixed("base.", self.base.state_dict())

    @classmethod
    def from_state(cls, state: StateDict) -> Self:
        """Inverse of ``state_dict`` of the same class. Raises ModelFileError where it does not fit."""
        with within("base."):
            base = cls.BASE.from_state(under("base.", state))
        settings = {
            name: tuple(value.tolist()) if isinstance(value, np.ndarray) else value
            for name, value in under("config.", state).items()
        }
        try:
            made = cls(base, cls.CONFIG(**settings))
        except (TypeError, ValueError) as error:
            raise ModelFileError(f"state: settings damaged: {error}; start from the model file") from error
        own = {name: value for name, value in state.items() if not name.startswith(("base.", "config."))}
        restore(made, own, made.sizes, made.given)
        made._restored()
        return made

    def restored(self, state: StateDict) -> OnlineModel:
        """A baseline of this class with ``state``. Raises ModelFileError where it does not fit."""
        return self.from_state(state)

    def _restored(self) -> None:
        """Make anew what follows from the state."""


# --- Online least squares with forgetting and lower bounds on the weights, for models that are linear in them.
#
# The normal matrix of all samples, in which each new sample scales the older ones by one factor, is the exact recursive
# least-squares problem in information form. Unlike the covariance form it admits bounds on the weights and cannot wind
# up. It starts from samples that the identified model generates over its own range, so learning begins at the
# identified weights and leaves them as real samples arrive. Only samples that teach age the older ones; a stage at rest
# forgets nothing.
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
def _forget_and_add(normal: FloatArray, row: FloatArray, keep: float) -> None:
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

    CONFIG = LeastSquaresConfig

    _normal: Annotated[FloatArray, Entry("normal matrix of the remembered samples", "", "rows,rows")]
    _recent: Annotated[deque[tuple[float, float]], Entry("last voltages and readings", "V, µm", "*,2")]
    _taught_u: Annotated[
        float,
        Entry("voltage of the last sample that taught, at first infinite", "V", finite=False, name="taught_u_V"),
    ]
    _pending: Annotated[FloatArray, Entry("part of a row that depends on the voltage", "", "pending|0")]

    @property
    @abstractmethod
    def pending_size(self) -> int:
        """Number of regressors that depend on the voltage."""

    @property
    def sizes(self) -> dict[str, int]:
        return {"rows": len(self._normal), "pending": self.pending_size}

    def check_state(self, values: dict[str, Any]) -> None:
        if not values["_pending"].size and values["_since_start"] >= self.config.learn_every:
            raise ValueError(f"pending: got nothing, expected {self.pending_size} numbers")

    def __init__(self, dt_s: float, u_range_V: float, config: LeastSquaresConfig, rows: FloatArray) -> None:
        super().__init__(dt_s, config.settle)
        import scipy.optimize  # noqa: F401 - slow to import: here, so that no sample waits for it

        self.config = config
        self._step_V = config.excitation * u_range_V
        self._keep = 1.0 - 1.0 / config.remember
        self._normal = (rows.T @ rows) * (config.trust / rows.shape[0])
        self._recent = deque(maxlen=2 * _HALF + 1)
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
        _forget_and_add(self._normal, row, self._keep)
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
