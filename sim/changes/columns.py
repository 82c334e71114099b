"""How the causes of a change show in a frozen inverse model's error.

The frozen model answers the measured motion with the voltage that the stage *as it was* would have needed. What is
applied differs from that by what has changed since. Each cause has a way to undo it in the motion (divide by the new
gain, look ahead by the new lag, ...), so its signature is the model's answer to the motion undone, less its answer to
the motion as measured, for a unit of the cause: hysteresis, lags and all, with no second model.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from adaptive.types import BoolArray, FloatArray, InverseModel
from baselines.prandtl_ishlinskii.operators import play_run, play_start

#: Time constants of the slow poles that creep is made of, s.
SLOW_S = (1.0, 10.0)
#: The cause whose column is a mere offset, which creep and the weather always move a little.
OFFSET = "thermal_drift"
#: Half-widths of the plays that the loop's shape is made of, shares of the range.
PLAY_SHARES = (0.02, 0.1)
#: Two histories of the loop are the same where the model's answers differ by less than this share of the range.
SURE_SHARE = 5e-4
#: Mains frequencies that are looked for, Hz.
MAINS_HZ = (50.0, 60.0)


@dataclass(frozen=True)
class Stretch:
    """Consecutive samples ``dt_s`` apart: voltages V, readings µm, smoothed motion (n, 3) of y, v, a.

    ``scored`` (n,) is False where a sample was filled in, and at the start, which only settles the memory.
    """

    dt_s: float
    t_s: FloatArray
    u_V: FloatArray
    motion: FloatArray
    scored: BoolArray


@dataclass(frozen=True)
class Scales:
    """What sizes are measured by: range and middle of the displacement, µm; slope V/µm; where 0 V would rest, µm."""

    range_um: float
    middle_um: float
    slope_V_per_um: float
    rest_um: float

    @staticmethod
    def of(stretch: Stretch) -> Scales:
        y, u = stretch.motion[:, 0], stretch.u_V
        low, high = np.quantile(y, [0.001, 0.999])
        d = y - y.mean()
        slope = float(d @ u / max(float(d @ d), 1e-30))
        rest = float(y.mean() - u.mean() / slope) if slope else float(y.mean())
        return Scales(float(high - low), float(0.5 * (high + low)), slope, rest)


@dataclass(frozen=True)
class Candidate:
    """A cause that may have come: its columns (n, k) in V, for one unit of each of its numbers.

    ``numbers`` names them with their units; ``least`` is the size below which nobody would call it a change.
    """

    name: str
    alternatives: tuple[str, ...]
    numbers: tuple[str, ...]
    least: float
    columns: FloatArray


def answer(model: InverseModel, motion: FloatArray, memory: FloatArray) -> FloatArray:
    """(n,) V: the frozen model's voltages for ``motion`` (n, 3), from ``memory`` on."""
    y, v, a = (np.ascontiguousarray(motion[:, i]) for i in range(3))
    return model.feedforward(y, v, a, memory).u_V


@dataclass(frozen=True)
class Base:
    """The frozen model over a stretch: memory at its start, voltages (n,) V, and where they can be relied on (n,)."""

    memory: FloatArray
    u_V: FloatArray
    sure: BoolArray


def base_of(model: InverseModel, stretch: Stretch, scales: Scales) -> Base:
    """The frozen model's answer to the motion as measured.

    Nobody knows the loop's memory where a stretch begins. So it is answered from two histories that lie as far apart as
    they can, and what the motion has not yet wiped out of them is not relied on; nor what lies outside the domain.
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
    sure = (apart < SURE_SHARE * abs(scales.slope_V_per_um) * scales.range_um) & one.inside & np.isfinite(one.u_V)
    return Base(ends[0], one.u_V, np.asarray(sure, dtype=np.bool_))


def candidates(model: InverseModel, stretch: Stretch, scales: Scales, base: Base) -> list[Candidate]:
    """The causes that a frozen model's error can tell, with their columns over ``stretch``."""
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
    # A hundredth of the range is moved for each difference: large beside rounding, small beside the loop.
    a_top = max(float(np.quantile(np.abs(a), 0.99)), 1e-12)
    step_s2 = min(1e-3 * span / a_top, (20.0 * dt) ** 2)
    found = [
        Candidate("gain_drift", (), ("gain",), 0.002, shown(gain, 0.01)),
        Candidate(
            OFFSET,
            ("creep",),
            ("offset_um",),
            0.005 * span,
            shown(lambda o: np.column_stack([y - o, v, a]), 0.01 * span),
        ),
        Candidate(
            "sensor_lag", ("amplifier_lag", "delay"), ("tau_s",), max(2e-5, 0.05 * dt), shown(lag, min(0.2 * dt, 2e-4))
        ),
        Candidate(
            "payload_change",
            ("resonance",),
            ("inverse_square_frequency_s2",),
            5e-9,
            shown(lambda k: np.column_stack([y + k * a, v, a]), step_s2),
        ),
        Candidate("sensor_nonlinearity", ("asymmetry",), ("bend",), 0.001, shown(bend, 0.005)),
        Candidate(
            "hysteresis_shape",
            ("rate_dependence", "asymmetry"),
            tuple(f"play_{100 * s:g}_pct" for s in PLAY_SHARES),
            0.002,
            loops(y, scales),
        ),
    ]
    return found


def loops(y_um: FloatArray, scales: Scales) -> FloatArray:
    """(n, 2) V: what a loop of the displacement, lagging by a play, adds for each width."""
    r = np.array(PLAY_SHARES) * scales.range_um
    plays = play_run(np.ascontiguousarray(y_um), r, play_start(float(y_um[0]), r, float(y_um[0])))
    return np.asarray(scales.slope_V_per_um * (y_um[:, None] - plays))


def slow(y_um: FloatArray, dt_s: float, scales: Scales) -> FloatArray:
    """(n, 2) V: the slow poles of the displacement: creep, which no frozen model holds in full."""
    rows = []
    for tau in SLOW_S:
        k = dt_s / (tau + dt_s)
        start = np.array([(1.0 - k) * (y_um[0] - scales.rest_um)])
        filtered, _ = lfilter([k], [1.0, k - 1.0], y_um - scales.rest_um, zi=start)
        rows.append(scales.slope_V_per_um * filtered)
    return np.column_stack(rows)


def hum(stretch: Stretch, left_V: FloatArray) -> Candidate | None:
    """A line at the mains frequency in ``left_V``, as a cause; None where the sample rate cannot show one."""
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
    return Candidate("mains_hum", (), ("sine_V", "cosine_V"), 0.0, np.column_stack([np.sin(phase), np.cos(phase)]))
