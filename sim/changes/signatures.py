"""How the causes of a change show in the error of a frozen inverse model.

The frozen model answers the measured motion with the voltage that the unchanged stage would have needed. The applied
voltage differs from it by what has changed since. Each cause can be undone in the motion (divide by the new gain, look
ahead by the new lag, ...). Its signature is the model's answer to the undone motion minus its answer to the measured
one, per unit of the cause. It includes hysteresis and lags and needs no second model.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from adaptive.types import BoolArray, FloatArray, InverseModel
from baselines.prandtl_ishlinskii.operators import play_run, play_start

#: Time constants of the slow poles that represent creep, s.
SLOW_S = (1.0, 10.0)
#: The cause whose column is an offset, which creep and temperature always move a little.
OFFSET = "thermal_drift"
#: Half-widths of the plays that represent the shape of the loop, as shares of the range.
PLAY_SHARES = (0.02, 0.1)
#: The history of the loop has no influence where the answers from two histories differ by less than this share of the
#: range.
CERTAIN_SHARE = 5e-4
#: Mains frequencies to search for, Hz.
MAINS_HZ = (50.0, 60.0)


@dataclass(frozen=True)
class Stretch:
    """Consecutive samples of a stage.

    Attributes
    ----------
    dt_s : sample time, s. t_s, u_V : (n,) times s and voltages V.
    motion : (n, 3) smoothed displacement µm, velocity µm/s, acceleration µm/s².
    scored : (n,) False where a sample was filled in, and at the start, which only settles the memory.
    """

    dt_s: float
    t_s: FloatArray
    u_V: FloatArray
    motion: FloatArray
    scored: BoolArray


@dataclass(frozen=True)
class Scales:
    """Units of size: range and middle of the displacement µm, slope V/µm, displacement at 0 V µm."""

    range_um: float
    middle_um: float
    slope_V_per_um: float
    rest_um: float

    @staticmethod
    def of(stretch: Stretch) -> Scales:
        """The scales of a stretch."""
        y, u = stretch.motion[:, 0], stretch.u_V
        low, high = np.quantile(y, [0.001, 0.999])
        d = y - y.mean()
        slope = float(d @ u / max(float(d @ d), 1e-30))
        rest = float(y.mean() - u.mean() / slope) if slope else float(y.mean())
        return Scales(float(high - low), float(0.5 * (high + low)), slope, rest)


@dataclass(frozen=True)
class ChangeCause:
    """A possible cause of a change.

    Attributes
    ----------
    name, alternatives : the cause, and other causes with the same signature.
    numbers : names of its k numbers, with units.
    least : smallest size that counts as a change.
    columns : (n, k) V, its signature for one unit of each number.
    """

    name: str
    alternatives: tuple[str, ...]
    numbers: tuple[str, ...]
    least: float
    columns: FloatArray


def answer(model: InverseModel, motion: FloatArray, memory: FloatArray) -> FloatArray:
    """Voltages (n,) V of the frozen model for ``motion`` (n, 3), starting from ``memory``."""
    y, v, a = (np.ascontiguousarray(motion[:, i]) for i in range(3))
    return model.feedforward(y, v, a, memory).u_V


@dataclass(frozen=True)
class FrozenAnswer:
    """The frozen model over a stretch: memory at its start, voltages (n,) V, and where these are certain (n,)."""

    memory: FloatArray
    u_V: FloatArray
    certain: BoolArray


def frozen_answer(model: InverseModel, stretch: Stretch, scales: Scales) -> FrozenAnswer:
    """The answer of the frozen model to the measured motion.

    The memory at the start of a stretch is unknown. The model therefore answers from two extreme histories. Samples at
    which their difference has not yet been wiped out are not certain, nor are those outside the model's domain.
    """
    y, v, a = (np.ascontiguousarray(stretch.motion[:, i]) for i in range(3))
    ends = []
    for extreme in (float(y.max()), float(y.min())):
        way = np.concatenate([np.linspace(y[0], extreme, 50), np.linspace(extreme, y[0], 50)])
        still = np.zeros(way.size)
        volts = scales.slope_V_per_um * (way - scales.rest_um)
        ends.append(model.track(way, still, still, volts, model.rest_memory(float(way[0]))))
    one, other = (model.feedforward(y, v, a, memory) for memory in ends)
    apart = np.abs(one.u_V - other.u_V)
    certain = (apart < CERTAIN_SHARE * abs(scales.slope_V_per_um) * scales.range_um) & one.inside & np.isfinite(one.u_V)
    return FrozenAnswer(ends[0], one.u_V, np.asarray(certain, dtype=np.bool_))


def causes_of(model: InverseModel, stretch: Stretch, scales: Scales, base: FrozenAnswer) -> list[ChangeCause]:
    """The causes that can be recognised in the error of a frozen model, with their columns over ``stretch``."""
    y, v, a = stretch.motion.T
    half, rest = 0.5 * scales.range_um, scales.rest_um

    def shown(undo: Callable[[float], FloatArray], step: float) -> FloatArray:
        return (answer(model, undo(step), base.memory) - base.u_V)[:, None] / step

    def gain(g: float) -> FloatArray:
        s = 1.0 / (1.0 + g)
        return np.column_stack([rest + s * (y - rest), s * v, s * a])

    def lag(tau: float) -> FloatArray:
        return np.column_stack([y + tau * v, v + tau * a, a])

    def bend(share: float) -> FloatArray:
        x = (y - scales.middle_um) / half
        return np.column_stack([y - share * half * (x * x - 1.0), v * (1.0 - 2.0 * share * x), a])

    dt, span = stretch.dt_s, scales.range_um
    # Differences use a hundredth of the range: large against round-off, small against the loop.
    a_top = max(float(np.quantile(np.abs(a), 0.99)), 1e-12)
    step_s2 = min(1e-3 * span / a_top, (20.0 * dt) ** 2)
    found = [
        ChangeCause("gain_drift", (), ("gain",), 0.002, shown(gain, 0.01)),
        ChangeCause(
            OFFSET,
            ("creep",),
            ("offset_um",),
            0.005 * span,
            shown(lambda o: np.column_stack([y - o, v, a]), 0.01 * span),
        ),
        ChangeCause(
            "sensor_lag", ("amplifier_lag", "delay"), ("tau_s",), max(2e-5, 0.05 * dt), shown(lag, min(0.2 * dt, 2e-4))
        ),
        ChangeCause(
            "payload_change",
            ("resonance",),
            ("inverse_square_frequency_s2",),
            5e-9,
            shown(lambda k: np.column_stack([y + k * a, v, a]), step_s2),
        ),
        ChangeCause("sensor_nonlinearity", ("asymmetry",), ("bend",), 0.001, shown(bend, 0.005)),
        ChangeCause(
            "hysteresis_shape",
            ("rate_dependence", "asymmetry"),
            tuple(f"play_{100 * s:g}_pct" for s in PLAY_SHARES),
            0.002,
            loops(y, scales),
        ),
    ]
    return found


def loops(y_um: FloatArray, scales: Scales) -> FloatArray:
    """(n, 2) V: the part of a loop that lags the displacement by a play, for each width."""
    r = np.array(PLAY_SHARES) * scales.range_um
    plays = play_run(np.ascontiguousarray(y_um), r, play_start(float(y_um[0]), r, float(y_um[0])))
    return np.asarray(scales.slope_V_per_um * (y_um[:, None] - plays))


def slow(y_um: FloatArray, dt_s: float, scales: Scales) -> FloatArray:
    """(n, 2) V: the displacement through slow poles, which represent the creep that a frozen model lacks."""
    rows = []
    for tau in SLOW_S:
        k = dt_s / (tau + dt_s)
        start = np.array([(1.0 - k) * (y_um[0] - scales.rest_um)])
        filtered, _ = lfilter([k], [1.0, k - 1.0], y_um - scales.rest_um, zi=start)
        rows.append(scales.slope_V_per_um * filtered)
    return np.column_stack(rows)


def hum(stretch: Stretch, left_V: FloatArray) -> ChangeCause | None:
    """A mains line in the residual ``left_V`` (n,), as a cause; None where the sample rate is too low for one."""
    t = stretch.t_s - stretch.t_s[0]
    window = np.hanning(t.size) * stretch.scored
    best, peak = 0.0, -1.0
    for mains in MAINS_HZ:
        if mains * stretch.dt_s > 0.45:
            continue
        for f in mains + np.arange(-0.5, 0.501, 0.25 / max(t[-1], 1.0)):
            power = abs(np.sum(window * left_V * np.exp(-2j * np.pi * f * t)))
            if power > peak:
                best, peak = float(f), float(power)
    if best == 0.0:
        return None
    phase = 2.0 * np.pi * best * t
    return ChangeCause("mains_hum", (), ("sine_V", "cosine_V"), 0.0, np.column_stack([np.sin(phase), np.cos(phase)]))
