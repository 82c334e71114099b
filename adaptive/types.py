"""The few types that every layer shares. Units: displacement µm, voltage V, time s."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
#: What a model writes into a file: arrays and JSON scalars under flat names.
StateDict = dict[str, Any]


class Feedforward(NamedTuple):
    """The answer of an inverse model to a trajectory of n points, ``dt_s`` apart.

    Attributes
    ----------
    u_V : (n,) voltage, V. Not yet limited: the guard of the service does that.
    std_V : (n,) one standard deviation of ``u_V``, V; NaN where the model has no notion of it.
    inside : (n,) True where the point lies inside the domain that the model has learnt.
    memory : (m,) hysteresis memory after the last point; the next query brings it back.
    """

    u_V: FloatArray
    std_V: FloatArray
    inside: BoolArray
    memory: FloatArray


@runtime_checkable
class InverseModel(Protocol):
    """An immutable inverse model: desired displacement in, voltage out.

    Points of a trajectory are ``dt_s`` apart. Velocity in µm/s and acceleration in µm/s² are those of the
    same instant as the displacement. Hysteresis has memory; it travels with the caller as a flat vector of
    ``memory_size`` doubles, so that a call is a pure function of its arguments.
    """

    @property
    def name(self) -> str: ...
    @property
    def dt_s(self) -> float: ...
    @property
    def memory_size(self) -> int: ...

    def rest_memory(self, y_um: float) -> FloatArray:
        """Memory of a stage that has come to rest at ``y_um`` from its rest position."""
        ...

    def feedforward(
        self,
        y_um: FloatArray,
        v_um_per_s: FloatArray,
        a_um_per_s2: FloatArray,
        memory: FloatArray,
    ) -> Feedforward:
        """Voltages for n desired points; inputs are (n,) and are not changed. Raises InputError on bad shapes."""
        ...

    def track(
        self,
        y_um: FloatArray,
        v_um_per_s: FloatArray,
        a_um_per_s2: FloatArray,
        u_V: FloatArray,
        memory: FloatArray,
    ) -> FloatArray:
        """Memory after n *measured* points with the voltages that were really applied."""
        ...

    def state_dict(self) -> StateDict:
        """Everything needed to build an equal model again with ``from_state``."""
        ...


@dataclass(frozen=True, slots=True)
class Sample:
    """One sample of a stage. ``u_V`` is applied from ``t_s`` on; ``y_um`` is the sensor's reading at ``t_s``."""

    seq: int
    t_s: float
    u_V: float
    y_um: float


@runtime_checkable
class SelfWatching(Protocol):
    """An online model that knows when its samples are not fit to learn from, and says so."""

    @property
    def trouble(self) -> str:
        """Name of what is wrong, "" while nothing is."""
        ...

    @property
    def why(self) -> str:
        """The reason in words."""
        ...

    @property
    def distrusts(self) -> bool:
        """Whether the readings are on trial: what it serves is from before them, and goes on without them."""
        ...


class OnlineModel(Protocol):
    """A model that learns sample by sample; the learner and all adaptive baselines are of this kind.

    Deterministic: the same samples in the same order give the same snapshots to the last bit.
    """

    @property
    def seq(self) -> int:
        """Sequence number of the last sample handled, -1 before any."""
        ...

    def handle(self, sample: Sample) -> str:
        """Take one sample. Returns ``"learnt"`` or the name of the gate that refused it; never raises on data."""
        ...

    def snapshot(self) -> InverseModel:
        """The model as it stands, immutable, cheap (at most some tens of µs)."""
        ...

    def counters(self) -> dict[str, int]:
        """How many samples were learnt, and refused by reason; numerical events too."""
        ...

    def state_dict(self) -> StateDict: ...
