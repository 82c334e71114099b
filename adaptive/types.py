"""The few types that every layer shares. Units: displacement µm, voltage V, time s."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]
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


@dataclass(frozen=True, slots=True)
class Hyperparameters:
    """gamma : regularisation, positive. widths : (d,) kernel widths, one an input, dimensionless, positive."""

    gamma: float
    widths: tuple[float, ...]


@dataclass(frozen=True)
class WindowData:
    """A copy of the learner's window, to tune its hyper-parameters in another process.

    Attributes
    ----------
    kernel : (n, d) kernel inputs, dimensionless. targets_V : (n,) voltage less the linear part, V.
    age : (n,) steps of the window since each sample was taken, 0 for the newest.
    hyper : the hyper-parameters that the window works with.
    """

    kernel: FloatArray
    targets_V: FloatArray
    age: FloatArray
    hyper: Hyperparameters


class MovingPart(NamedTuple):
    """The parameters of a learnt model that change with each step of its linear part. Copies.

    Attributes
    ----------
    gain, offset_um : the frame. beta : (p,) linear part, V, without the bias of the kernel part.
    domain : (6,) learnt range. noise_variance : V².
    memory : (m,) hysteresis memory after the last sample.
    kernel : stands for the kernel part and its hyper-parameters as a whole; another object where they were replaced.
    """

    gain: float
    offset_um: float
    beta: FloatArray
    domain: FloatArray
    noise_variance: float
    memory: FloatArray
    kernel: object


class OnlineModel(Protocol):
    """A model that learns sample by sample: the learner, every adaptive baseline, and a competition between them.

    Deterministic: the same samples in the same order give the same snapshots to the last bit. Not for several threads
    at once. All that a service needs of a learner is declared here, so that a type checker sees each use. A model that
    lacks an ability implements it trivially and says so; see ``baselines.online_baseline.OnlineBaseline``.
    """

    # ---- samples in

    @property
    def seq(self) -> int:
        """Sequence number of the last sample handled, -1 before any."""
        ...

    def handle(self, sample: Sample) -> str:
        """Take one sample. Returns ``"learnt"`` or the name of the gate that refused it; never raises on data."""
        ...

    def resync(self) -> None:
        """Forget the sequence: take the next sample whatever its number and time, as after a restart of the stage."""
        ...

    def take_place_of(self, other: OnlineModel) -> None:
        """Continue at the position of ``other`` with the parameters learnt here; ``resync`` where the types differ."""
        ...

    # ---- learning on and off

    def freeze(self) -> None:
        """Stop learning. Samples still advance memory and error statistics."""
        ...

    def thaw(self) -> None:
        """Resume learning."""
        ...

    # ---- models out

    @property
    def base(self) -> InverseModel:
        """The identified model that learning started from."""
        ...

    def snapshot(self) -> InverseModel:
        """The current model, immutable; costs at most some tens of µs."""
        ...

    def moving(self) -> MovingPart | None:
        """What has moved since the last snapshot, at little cost; None where only a whole snapshot can tell."""
        ...

    def memory_for(self, model: InverseModel, smoothed: bool = False) -> FloatArray | None:
        """(m,) hysteresis memory with which ``model``, a snapshot of this one, continues after the last sample.

        ``smoothed`` : the memory at the smoother's instant instead. None where this model tracks no memory of its own.
        """
        ...

    # ---- hyper-parameters tuned elsewhere

    def window_data(self) -> WindowData | None:
        """A copy of the samples to tune hyper-parameters on; None where there are none to tune."""
        ...

    def adopt(self, hyper: Hyperparameters) -> str:
        """Continue with other hyper-parameters from the present sample on. Returns "", or why they are refused."""
        ...

    # ---- reports

    @property
    def trouble(self) -> str:
        """Name of what makes the samples or the model unfit to learn from, "" while nothing does."""
        ...

    @property
    def why(self) -> str:
        """The reason for ``trouble`` in words."""
        ...

    @property
    def distrusts(self) -> bool:
        """Whether the sensor is on trial: the snapshot is then from before its readings became doubtful."""
        ...

    def counters(self) -> dict[str, int]:
        """Samples by outcome (learnt, or refused by which gate), and numerical events."""
        ...

    def diagnostics(self) -> dict[str, Any]:
        """Errors, gain and other figures for a viewer; empty where there are none."""
        ...

    def take_events(self) -> list[tuple[str, str]]:
        """(event, detail) since the last call, oldest first."""
        ...

    # ---- keeping

    def warm(self) -> None:
        """Load every compiled step, so that no sample waits for the compiler."""
        ...

    def state_dict(self) -> StateDict:
        """The whole state, flat; ``restored`` continues from it to the same last bit."""
        ...

    def restored(self, state: StateDict) -> OnlineModel:
        """A model like this one with ``state``. Raises ModelFileError where entries are missing or do not fit."""
        ...


# --- Nested states as flat entries, whose names have the prefix of their part.


def prefixed(prefix: str, state: Mapping[str, Any]) -> StateDict:
    """The same entries under prefixed names."""
    return {f"{prefix}{name}": value for name, value in state.items()}


def under(prefix: str, state: Mapping[str, Any]) -> StateDict:
    """The entries whose names begin with ``prefix``, without it: the inverse of ``prefixed``."""
    return {name[len(prefix) :]: value for name, value in state.items() if name.startswith(prefix)}


def parted(state: Mapping[str, Any]) -> dict[str, StateDict]:
    """All entries by the part of their names before the first dot; {} for one that there is not. Inverse of ``joined``.

    In one pass: a fleet restores a learner for each sample that one of its axes cannot use, and has no time to lose.
    """
    parts: dict[str, StateDict] = defaultdict(dict)
    for name, value in state.items():
        part, _, rest = name.partition(".")
        parts[part][rest] = value
    return parts


def joined(parts: Mapping[str, Mapping[str, Any]]) -> StateDict:
    """The entries of several states, each under ``NAME.``."""
    return {f"{part}.{name}": value for part, state in parts.items() for name, value in state.items()}
