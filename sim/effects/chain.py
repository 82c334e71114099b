"""A chain of effects in the order of the signal's way, and its plan: what the compiled loop runs."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adaptive.errors import InputError
from adaptive.types import FloatArray
from sim.effects.base import SENSOR_FROM, Context, Effect, Place
from sim.effects.counter_noise import stream
from sim.effects.kernel import run_chain

IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class Chain:
    """Effects ordered by their place; labels are unique. ``chain + effect`` and ``chain + chain`` compose.

    Effects of one place keep the order in which they were given.
    """

    effects: tuple[Effect, ...] = ()

    def __post_init__(self) -> None:
        ordered = tuple(sorted(self.effects, key=lambda e: e.kind.place))
        object.__setattr__(self, "effects", ordered)
        labels = [e.label for e in ordered]
        for label in labels:
            if labels.count(label) > 1:
                raise InputError(
                    f"effects: {label!r} appears twice, expected unique labels; give one a label of its own"
                )

    def __add__(self, other: Effect | Chain | Iterable[Effect]) -> Chain:
        more = (other,) if isinstance(other, Effect) else tuple(other)
        return Chain(self.effects + more)

    def __iter__(self) -> Iterator[Effect]:
        return iter(self.effects)

    def __len__(self) -> int:
        return len(self.effects)

    def __contains__(self, label: object) -> bool:
        return any(e.label == label for e in self.effects)

    def __getitem__(self, label: str) -> Effect:
        for effect in self.effects:
            if effect.label == label:
                return effect
        known = ", ".join(e.label for e in self.effects)
        raise InputError(f"effects: no {label!r} in this chain, expected one of: {known}")

    @property
    def parameters(self) -> dict[str, float]:
        """All parameter values by ``label.parameter``."""
        return {f"{e.label}.{name}": value for e in self.effects for name, value in e.values.items()}

    def replace(self, values: Mapping[str, float]) -> Chain:
        """The chain with parameters changed by ``label.parameter``. Raises InputError on names and ranges."""
        grouped: dict[str, dict[str, float]] = {}
        for path, value in values.items():
            label, _, name = path.rpartition(".")
            self[label].kind.parameter(name, label)
            grouped.setdefault(label, {})[name] = value
        return Chain(tuple(e.replace(**grouped[e.label]) if e.label in grouped else e for e in self.effects))

    def without(self, label: str) -> Chain:
        """The chain less one effect."""
        gone = self[label]
        return Chain(tuple(e for e in self.effects if e is not gone))

    def contexts(self, dt_s: float, seed: int, axis: int) -> list[Context]:
        """The context of each effect: how signals go between samples, what mass was added, its own seed.

        Raises InputError where a payload has no mode to move.
        """
        names = {e.name for e in self.effects}
        if "payload_change" in names and not names & {"resonance", "mechanics"}:
            raise InputError(
                "effects: payload_change got no mode to move, expected resonance or mechanics in the chain"
            )
        hold, payload = np.inf, 0.0
        for effect in self.effects:
            if effect.name == "amplifier_lag" and effect.values["tau_s"] > 0.0:
                hold = min(hold, 1.0 / effect.values["tau_s"])
            if effect.name == "payload_change":
                payload += effect.values["payload_ratio"]
        start = Context(dt_s, 0, float(hold), payload)
        return [dataclasses.replace(start, seed=stream(seed, axis, e.label)) for e in self.effects]


@dataclass(frozen=True, slots=True)
class Plan:
    """Chains of one or two axes, laid out for the compiled loop. Made by `plan`."""

    addresses: IntArray
    axes: IntArray
    p_at: IntArray
    s_at: IntArray
    marks: IntArray
    p: FloatArray
    rest: FloatArray
    n_axes: int

    def run(
        self, s: FloatArray, x: FloatArray, k0: int, other_um: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Advance state ``s`` (in place) by the commands ``x`` (axes, n), which become the readings (in place).

        ``k0`` is the index of the reading after ``x[:, 0]``. ``other_um`` (n,): displacement of the other axis
        where only one is simulated. Returns the true displacements before the sensor and the drive voltages.
        """
        v, true = np.empty_like(x), np.empty_like(x)
        w = np.zeros_like(x) if other_um is None else np.ascontiguousarray(other_um, dtype=np.float64).reshape(x.shape)
        run_chain(self.addresses, self.axes, self.p_at, self.s_at, self.marks, self.p, s, x, v, w, true, k0)
        return true, v


def plan(chains: tuple[Chain, ...], dt_s: float, seed: int = 0) -> Plan:
    """Lay out the chains of one or two axes for a sample time. Costs some tens of µs; compiles nothing anew."""
    items: list[tuple[Place, int, int, list[float], list[float]]] = []
    for axis, chain in enumerate(chains):
        for effect, context in zip(chain, chain.contexts(dt_s, seed, axis), strict=True):
            if effect.kind.block is None:
                continue
            values = effect.values
            p, s = list(effect.kind.derive(values, context)), list(effect.kind.rest(values, context))
            items.append((effect.kind.place, axis, effect.kind.block.address, p, s))
    items.sort(key=lambda item: item[0])
    places = [item[0] for item in items]

    def first(place: Place) -> int:
        return next((i for i, p in enumerate(places) if p >= place), len(places))

    sizes_p = [0, *(len(item[3]) for item in items)]
    sizes_s = [0, *(len(item[4]) for item in items)]
    return Plan(
        addresses=np.array([item[2] for item in items], dtype=np.int64),
        axes=np.array([item[1] for item in items], dtype=np.int64),
        p_at=np.cumsum(sizes_p)[:-1].astype(np.int64),
        s_at=np.cumsum(sizes_s)[:-1].astype(np.int64),
        marks=np.array(
            [first(Place.ACTUATOR), first(Place.CROSS_TALK) if len(chains) == 2 else -1, first(SENSOR_FROM)],
            dtype=np.int64,
        ),
        # one number more, so that the pointer of a last effect without any is valid
        p=np.array([v for item in items for v in item[3]] + [0.0], dtype=np.float64),
        rest=np.array([v for item in items for v in item[4]] + [0.0], dtype=np.float64),
        n_axes=len(chains),
    )


def simulate(
    chain: Chain,
    u_V: FloatArray,
    dt_s: float,
    *,
    params: Mapping[str, float] | None = None,
    other_um: FloatArray | None = None,
    seed: int = 0,
) -> FloatArray:
    """Readings ``y_um`` (n,) of one axis at rest at 0 V, to which the commands ``u_V`` (n,) are applied.

    ``y_um[k]`` is read at ``t_k``; ``u_V[k]`` is held from ``t_k`` to ``t_(k+1)``, so it does not change it.
    ``params`` changes parameters by ``label.parameter``. ``other_um`` (n,) is the displacement of the other axis
    at ``t_k`` for `cross_talk`. Nothing is compiled anew for other values. Raises InputError on bad arrays.
    """
    u = np.asarray(u_V, dtype=np.float64)
    if u.ndim != 1 or u.size == 0 or not np.all(np.isfinite(u)):
        raise InputError(
            f"u_V: got shape {u.shape}, expected a one-dimensional array of finite voltages; clean it first"
        )
    if other_um is not None and np.shape(other_um) != u.shape:
        raise InputError(f"other_um: got shape {np.shape(other_um)}, expected that of u_V, {u.shape}")
    layout = plan((chain if params is None else chain.replace(params),), dt_s, seed)
    # the reading at t_0 follows from one more step of rest before it
    x = np.concatenate(([0.0], u[:-1]))[None, :].copy()
    layout.run(layout.rest.copy(), x, 0, other_um)
    reading: FloatArray = x[0]
    return reading
