"""A simulated stage: chains of effects for one or two axes, limits, a seed, and parameter changes over time.

`StageState` holds everything that moves. ``step`` and ``run`` give identical bits, and two stages of equal
configuration that get the same commands give the same readings, noise included.

Time: the sensor is read at ``t_k = k dt``, and the command ``u_k`` is held from ``t_k`` until ``t_(k+1)``. A reading at
``t_k`` therefore does not depend on ``u_k``: a controller may read (`Stage.read`), decide, then step.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray
from dehyst.sim.effects import Chain, Plan, plan
from dehyst.sim.effects.simulation import run_chain
from dehyst.sim.stage.config import StageConfig, changed


@dataclass
class StageState:
    """State of a stage. Made by `Stage.initial_state`, advanced in place by ``step`` and ``run``.

    Attributes
    ----------
    k : index of the next reading; its time is ``k dt``.
    plan : coefficients in force.
    s : states of all effects.
    reading_um, true_um : the next reading (axes,) and the true displacement then (axes, 1).
    chains : parameters in force.
    pending : index of the next of the configuration's changes.
    next_change : first sample of that change; -1: none.
    x, v, w : work space of ``step``.
    """

    k: int
    plan: Plan
    s: FloatArray
    reading_um: FloatArray
    true_um: FloatArray
    chains: tuple[Chain, ...]
    pending: int
    next_change: int
    x: FloatArray = field(repr=False)
    v: FloatArray = field(repr=False)
    w: FloatArray = field(repr=False)

    def copy(self) -> StageState:
        """An independent copy."""
        arrays = {name: getattr(self, name).copy() for name in ("s", "reading_um", "true_um", "x", "v", "w")}
        return StageState(
            k=self.k, plan=self.plan, chains=self.chains, pending=self.pending, next_change=self.next_change, **arrays
        )


@dataclass(frozen=True, slots=True)
class Trace:
    """All of a run, arrays (n,): readings and true displacements (before the sensor) µm, voltage at the actuator V."""

    t_s: FloatArray
    y_um: FloatArray
    y2_um: FloatArray
    true_um: FloatArray
    drive_V: FloatArray


class Stage:
    """Steps a configuration through time. Immutable; all that moves is in a `StageState`."""

    def __init__(self, config: StageConfig) -> None:
        self.config = config
        self._plan = plan(config.chains, config.dt_s, config.seed)
        self._change_at = [math.ceil(t_s / config.dt_s - 1e-9) for t_s, _ in config.changes]

    def initial_state(self) -> StageState:
        """State of a stage that has always been at rest at 0 V, before the reading at t = 0."""
        axes = self._plan.n_axes
        state = StageState(
            k=-1,
            plan=self._plan,
            s=self._plan.rest.copy(),
            reading_um=np.zeros(axes),
            true_um=np.zeros((axes, 1)),
            chains=self.config.chains,
            pending=0,
            next_change=self._change_at[0] if self._change_at else -1,
            x=np.zeros((axes, 1)),
            v=np.zeros((axes, 1)),
            w=np.zeros((axes, 1)),
        )
        self._advance(state, np.zeros((axes, 1)))
        return state

    def _advance(self, state: StageState, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Run the commands ``x`` (axes, m), which become the readings at the ends of the steps; no change between."""
        true, drive = state.plan.run(state.s, x, state.k + 1)
        state.k += x.shape[1]
        state.reading_um[:] = x[:, -1]
        state.true_um[:] = true[:, -1:]
        return true, drive

    def _apply_due(self, state: StageState) -> None:
        """Apply the changes that hold from the reading after ``state.k`` on."""
        while state.pending < len(self._change_at) and self._change_at[state.pending] <= state.k + 1:
            self._set(state, self.config.changes[state.pending][1])
            state.pending += 1
        state.next_change = self._change_at[state.pending] if state.pending < len(self._change_at) else -1

    def _set(self, state: StageState, values: Mapping[str, float]) -> None:
        state.chains = changed(state.chains, values)
        state.plan = plan(state.chains, self.config.dt_s, self.config.seed)

    def with_changes(self, state: StageState, values: Mapping[str, float]) -> StageState:
        """A copy of ``state`` with other parameters from the next step on; the motion is continuous.

        Raises InputError on unknown names and axes, and values out of range.
        """
        new = state.copy()
        self._set(new, values)
        return new

    def read(self, state: StageState) -> tuple[float, float]:
        """The present readings (y, y2), µm, before any command; y2 is 0 for one axis."""
        y = state.reading_um
        return float(y[0]), float(y[1]) if y.size == 2 else 0.0

    def true(self, state: StageState) -> tuple[float, float]:
        """The present displacements, µm, without sensor, noise and quantisation."""
        y = state.true_um[:, 0]
        return float(y[0]), float(y[1]) if y.size == 2 else 0.0

    def step(self, state: StageState, u_V: float, u2_V: float = 0.0) -> tuple[float, float]:
        """Read (y, y2) µm at ``t_k``, then hold the commands, V, until ``t_(k+1)``. Advances ``state``.

        Commands are clamped to the limits. Raises InputError where one is not finite, without changing the state.
        """
        c = self.config
        if not (math.isfinite(u_V) and math.isfinite(u2_V)):
            raise InputError(f"u_V, u2_V: got {u_V!r}, {u2_V!r}, expected finite voltages; hold the last one instead")
        if 0 <= state.next_change <= state.k + 1:
            self._apply_due(state)
        x, q, y = state.x, state.plan, state.reading_um
        x[0, 0] = min(max(u_V, c.u_min_V), c.u_max_V)
        two = q.n_axes == 2
        now = (float(y[0]), float(y[1]) if two else 0.0)
        if two:
            x[1, 0] = min(max(u2_V, c.u_min_V), c.u_max_V)
        run_chain(
            q.addresses, q.axes, q.p_at, q.s_at, q.marks, q.p, state.s, x, state.v, state.w, state.true_um, state.k + 1
        )
        state.k += 1
        y[:] = x[:, 0]
        return now

    def run(self, state: StageState, u_V: FloatArray, u2_V: FloatArray | None = None) -> tuple[FloatArray, FloatArray]:
        """Readings (y, y2), (n,) µm each, of n steps with commands (n,) V. Advances ``state``.

        ``y[k]`` is read when ``u_V[k]`` begins to be held. Identical to n calls of ``step``. Raises InputError on bad
        shapes and values that are not finite, without changing the state.
        """
        trace = self.run_traced(state, u_V, u2_V)
        return trace.y_um, trace.y2_um

    def run_traced(self, state: StageState, u_V: FloatArray, u2_V: FloatArray | None = None) -> Trace:
        """As `run`, with the true displacements and the voltage at the actuator."""
        commands = self._commands(u_V, u2_V)
        axes, n = self._plan.n_axes, commands.shape[1]
        y, true = np.zeros((2, n + 1)), np.zeros((2, n + 1))
        drive = np.zeros(n)
        y[:axes, 0], true[:axes, 0] = state.reading_um, state.true_um[:, 0]
        first, done = state.k, 0
        while done < n:
            if 0 <= state.next_change <= state.k + 1:
                self._apply_due(state)
            end = n if state.next_change < 0 else min(n, done + state.next_change - state.k - 1)
            x = commands[:axes, done:end].copy()
            part, volts = self._advance(state, x)
            y[:axes, done + 1 : end + 1], true[:axes, done + 1 : end + 1] = x, part
            drive[done:end] = volts[0]
            done = end
        t_s = np.arange(first, first + n) * self.config.dt_s
        return Trace(t_s, y[0, :n], y[1, :n], true[0, :n], drive)

    def _commands(self, u_V: FloatArray, u2_V: FloatArray | None) -> FloatArray:
        u = np.asarray(u_V, dtype=np.float64)
        u2 = np.zeros_like(u) if u2_V is None else np.asarray(u2_V, dtype=np.float64)
        for name, array in (("u_V", u), ("u2_V", u2)):
            if array.ndim != 1 or array.shape != u.shape:
                raise InputError(
                    f"{name}: got shape {array.shape}, expected one dimension and the shape of u_V, {u.shape}"
                )
            bad = np.flatnonzero(~np.isfinite(array))
            if bad.size:
                raise InputError(f"{name}: got {array[bad[0]]} at index {bad[0]}, expected finite voltages")
        return np.clip(np.vstack((u, u2)), self.config.u_min_V, self.config.u_max_V)
