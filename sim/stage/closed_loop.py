"""Feedforward, feedback and both on a simulated stage, and its Ziegler-Nichols gains.

The controller reads ``y(t_k)``, computes ``u_k`` from the error at ``t_k`` and applies it until ``t_(k+1)``. Nothing of
a sample is used before it could be known.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dehyst.adaptive.errors import InputError, NumericsError
from dehyst.adaptive.types import FloatArray, InverseModel, OnlineModel, Sample
from dehyst.sim.signals.references import Reference
from dehyst.sim.stage.stage import Stage


@dataclass(frozen=True, slots=True)
class PID:
    """Incremental PID, (2.46), with continuous gains.

    ``u_FB(k) = u_FB(k-1) + k_p (e_k - e_(k-1)) + k_i T e_k + (k_d/T) (e_k - 2 e_(k-1) + e_(k-2))``.
    The chapter's K_i = 31.104 is the continuous gain; taken per sample it would be unstable at 11 µm/V.

    Attributes
    ----------
    k_p : V/µm. k_i : V/(µm s). k_d : V s/µm. dt_s : sample time T, s.

    Raises InputError on a negative gain or a sample time that is not positive.
    """

    k_p: float
    k_i: float
    k_d: float = 0.0
    dt_s: float = 1e-3

    def __post_init__(self) -> None:
        for name in ("k_p", "k_i", "k_d"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise InputError(f"{name}: got {value!r}, expected a finite gain from 0 on")
        if not (math.isfinite(self.dt_s) and self.dt_s > 0.0):
            raise InputError(f"dt_s: got {self.dt_s!r}, expected a sample time above 0 s")

    def step(self, state: PIDState, error_um: float) -> float:
        """Feedback voltage u_FB(k), V; advances ``state``."""
        e, e1, e2 = error_um, state.e1_um, state.e2_um
        state.u_V += self.k_p * (e - e1) + self.k_i * self.dt_s * e + self.k_d / self.dt_s * (e - 2.0 * e1 + e2)
        state.e1_um, state.e2_um = e, e1
        return state.u_V


#: The chapter's gains, section 2.5.3: 0.0864 V/µm and 31.104 V/(µm s).
CHAPTER_GAINS = PID(k_p=0.0864, k_i=31.1040)


@dataclass
class PIDState:
    """State of (2.46): its output and the last two errors."""

    u_V: float = 0.0
    e1_um: float = 0.0
    e2_um: float = 0.0

    def limit(self, wanted_V: float, applied_V: float) -> None:
        """Take the part of the output that the voltage limits cut off out of the integral."""
        self.u_V += applied_V - wanted_V


@dataclass(frozen=True, slots=True)
class Run:
    """A run under control; arrays (n,)."""

    t_s: FloatArray
    reference_um: FloatArray
    y_um: FloatArray
    u_V: FloatArray

    @property
    def error_um(self) -> FloatArray:
        """Reference minus reading (n,), µm."""
        return self.reference_um - self.y_um


@dataclass(frozen=True, slots=True)
class BlockConfig:
    """block : samples answered at once, >= 1. delay_blocks : age of the answering snapshot, blocks, >= 1.

    Raises InputError on smaller values.
    """

    block: int = 20
    delay_blocks: int = 3

    def __post_init__(self) -> None:
        if self.block < 1 or self.delay_blocks < 1:
            raise InputError(f"block, delay_blocks: got {self.block}, {self.delay_blocks}, expected at least 1 each")


def track(
    stage: Stage,
    reference: Reference,
    *,
    model: InverseModel | None = None,
    online: OnlineModel | None = None,
    pid: PID | None = None,
    config: BlockConfig | None = None,
) -> Run:
    """Follow a reference from rest with feedforward (``model`` or ``online``), feedback (``pid``), or both.

    ``online`` learns and is advanced: block by block, a snapshot that has seen no sample of the last ``delay_blocks``
    blocks gives the voltages of the next one, whose samples then teach it. That is what the service does. The
    feedforward of ``model`` depends on the reference alone and is one block.
    Where limits clamp the voltage, the feedback is set back by the clamped part, so that it does not wind up. Raises
    InputError where sample times differ, or neither model nor gains are given.
    """
    config, dt_s, n = config or BlockConfig(), stage.config.dt_s, reference.y_um.size
    first = model if online is None else online.snapshot()
    if first is None and pid is None:
        raise InputError("model, pid: got neither, expected a feedforward model, feedback gains or both")
    for name, other in (("model", first), ("pid", pid)):
        if other is not None and not math.isclose(other.dt_s, dt_s, rel_tol=1e-9):
            raise InputError(f"{name}: got a sample time of {other.dt_s} s, expected that of the stage, {dt_s} s")
    state, fed = stage.initial_state(), PIDState()
    low, high = stage.config.u_min_V, stage.config.u_max_V
    y, u, forward = np.empty(n), np.empty(n), np.zeros(n)
    snapshots = deque([first], maxlen=config.delay_blocks)
    memory = None if first is None else first.rest_memory(0.0)
    block = n if online is None else config.block
    for start in range(0, n, block):
        part = slice(start, min(n, start + block))
        if snapshots[0] is not None and memory is not None:
            motion = reference.y_um[part], reference.v_um_per_s[part], reference.a_um_per_s2[part]
            answer = snapshots[0].feedforward(*motion, memory)
            forward[part], memory = answer.u_V, answer.memory
        if pid is None:
            u[part] = np.clip(forward[part], low, high)
            y[part], _ = stage.run(state, u[part])
        else:
            for k in range(part.start, part.stop):
                y[k] = stage.read(state)[0]
                wanted = float(forward[k]) + pid.step(fed, float(reference.y_um[k]) - y[k])
                u[k] = min(max(wanted, low), high)
                fed.limit(wanted, float(u[k]))
                stage.step(state, float(u[k]))
        if online is not None:
            for k in range(part.start, part.stop):
                online.handle(Sample(k, k * dt_s, float(u[k]), float(y[k])))
            snapshots.append(online.snapshot())
    return Run(np.arange(n, dtype=np.float64) * dt_s, reference.y_um, y, u)


@dataclass(frozen=True, slots=True)
class UltimateGain:
    """Result of the Ziegler-Nichols experiment: proportional gain at the stability limit, and the period there."""

    gain_V_per_um: float
    period_s: float

    def pi_gains(self, dt_s: float, share: float = 1.0) -> PID:
        """Ziegler-Nichols PI gains ``k_p = 0.45 K_u``, ``k_i = k_p/(T_u/1.2)``; ``share`` scales both."""
        k_p = 0.45 * self.gain_V_per_um * share
        return PID(k_p=k_p, k_i=1.2 * k_p / self.period_s, dt_s=dt_s)


def ultimate_gain(
    stage: Stage, *, level_um: float = 45.0, kick_um: float = 1.0, settle_s: float = 0.5, watch_s: float = 0.5
) -> UltimateGain:
    """Find the proportional gain at which an oscillation neither grows nor decays, and its period.

    The stage is brought near ``level_um`` by its mean gain and settles for ``settle_s``. Then proportional feedback
    acts about that position, excited by a set-point pulse of ``kick_um``. The gain is bisected on whether the
    oscillation in the second half of ``watch_s`` exceeds that in the first. Raises NumericsError where no gain below
    10 V/µm makes the stage oscillate.
    """
    dt_s = stage.config.dt_s
    state = stage.initial_state()
    probe = 0.5 * stage.config.u_max_V
    settle = max(2, round(settle_s / dt_s))
    slope = stage.run_traced(state.copy(), np.full(settle, probe)).true_um[-1] / probe
    u0 = float(np.clip(level_um / slope, stage.config.u_min_V, stage.config.u_max_V))
    # a ramp, because a step would leave the mode ringing
    stage.run(state, u0 * np.minimum(1.0, np.arange(2 * settle) / settle))
    n = max(40, round(watch_s / dt_s))

    def response(gain: float) -> FloatArray:
        s = state.copy()
        centre = stage.true(s)[0]
        error = np.empty(n)
        for k in range(n):
            y = stage.read(s)[0]
            error[k] = centre + (kick_um if k < 3 else 0.0) - y
            u = u0 + gain * float(error[k])
            # only linear oscillation counts, not that at the limits
            if not stage.config.u_min_V < u < stage.config.u_max_V or abs(error[k]) > 20.0 * kick_um:
                return error[: k + 1]
            stage.step(s, u)
        return error

    def grows(gain: float) -> bool:
        error = response(gain)
        if error.size < n:
            return True
        first = float(np.std(np.diff(error[n // 8 : n // 2])))
        second = float(np.std(np.diff(error[n // 2 :])))
        # noise and creep stay below this share of the pulse
        return second > max(0.99 * first, 0.03 * kick_um)

    return _bisect(grows, response, dt_s)


def _bisect(grows: Callable[[float], bool], response: Callable[[float], FloatArray], dt_s: float) -> UltimateGain:
    """Bisect the gain to 0.1 %; the period comes from the zero crossings there."""
    low, high = 0.0, 1e-4
    while not grows(high):
        low, high = high, 1.5 * high
        if high > 10.0:
            raise NumericsError("ultimate gain: none below 10 V/µm makes the stage oscillate; set the gains by hand")
    while high - low > 1e-3 * high:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if grows(middle) else (middle, high)
    wave = response(high)
    wave = wave[wave.size // 4 :]
    wave = np.diff(wave) - np.mean(np.diff(wave))
    at = np.flatnonzero((wave[:-1] < 0.0) & (wave[1:] >= 0.0))
    if at.size < 2:
        raise NumericsError("ultimate gain: no oscillation to measure a period of; increase watch_s")
    # interpolated crossings
    exact = at + wave[at] / (wave[at] - wave[at + 1])
    return UltimateGain(high, float((exact[-1] - exact[0]) / (at.size - 1)) * dt_s)
