"""The pictures of causes as curves: the residual without it and with it, over the variable that shows it best.

Curves are numbers here; `service.reports.diagnosis` draws them as PNG.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from dehyst.adaptive.types import BoolArray, FloatArray
from dehyst.sim.fitting.fit_data import FitData
from dehyst.sim.masks import runs

#: Most points of a line over time.
MOST_POINTS = 4000


MEASURED, WITHOUT, WITH = "measured", "without it", "with it"


@dataclass(frozen=True)
class Curve:
    """One curve. ``role`` is MEASURED, WITHOUT or WITH; a second curve of one role is ``dashed``."""

    role: str
    x: FloatArray
    y: FloatArray
    note: str = ""
    dashed: bool = False
    points: bool = False
    name: str = ""

    @property
    def label(self) -> str:
        """Text for the legend."""
        return self.name or (f"{self.role}, {self.note}" if self.note else self.role)


@dataclass(frozen=True)
class Picture:
    """Curves over one pair of axes; ``marks`` are values of x that get a vertical line."""

    x_name: str
    y_name: str
    curves: tuple[Curve, ...]
    log_x: bool = False
    log_y: bool = False
    marks: tuple[float, ...] = ()


class Shown(Protocol):
    """What is drawn of a cause: the residual (n,), µm, without it and with it, and its numbers by name."""

    @property
    def before_um(self) -> FloatArray: ...
    @property
    def after_um(self) -> FloatArray: ...
    @property
    def parameters(self) -> dict[str, float]: ...


def envelope(t: FloatArray, values: FloatArray, most: int = MOST_POINTS) -> tuple[FloatArray, FloatArray]:
    """A line over time, ``t`` and ``values`` (n,), thinned to the extremes of equal stretches: no peak is lost."""
    if values.size <= most:
        return t, values
    width = -(-values.size // (most // 2))
    starts = np.arange(0, values.size, width)
    low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
    return np.repeat(t[starts], 2), np.column_stack([low, high]).ravel()


def binned(x: FloatArray, y: FloatArray, bins: int = 60) -> tuple[FloatArray, FloatArray]:
    """Means of ``y`` in equal bins of ``x``, without bins of few samples."""
    low, high = np.quantile(x, [0.001, 0.999])
    edges = np.linspace(low, high, bins + 1)
    place = np.clip(np.digitize(x, edges) - 1, 0, bins - 1)
    count = np.bincount(place, minlength=bins)
    mean = np.bincount(place, weights=y, minlength=bins) / np.maximum(count, 1)
    good = count > min(20, max(2, x.size // (4 * bins)))
    return 0.5 * (edges[1:] + edges[:-1])[good], mean[good]


def residual_unit(cause: Shown) -> tuple[float, str]:
    """Factor from µm, and name, of the unit of this cause's residual: nm, or µm if it is large."""
    return (1.0, "µm") if float(np.quantile(np.abs(cause.before_um), 0.99)) > 3.0 else (1e3, "nm")


def residuals(cause: Shown) -> tuple[tuple[str, FloatArray], tuple[str, FloatArray]]:
    scale = residual_unit(cause)[0]
    return (WITHOUT, scale * cause.before_um), (WITH, scale * cause.after_um)


def moving_mean(r_nm: FloatArray, width: int) -> FloatArray:
    """(n,) moving mean over ``width`` samples, shorter at the ends."""
    sums = np.concatenate([[0.0], np.cumsum(r_nm)])
    half = width // 2
    low = np.clip(np.arange(r_nm.size) - half, 0, r_nm.size)
    high = np.clip(np.arange(r_nm.size) + half + 1, 0, r_nm.size)
    return np.asarray((sums[high] - sums[low]) / (high - low))


def slowest_period(data: FitData) -> int:
    """Period of the slowest strong component of the drive, in samples."""
    u = data.u_V - data.u_V.mean()
    power = np.abs(np.fft.rfft(u * np.hanning(u.size))) ** 2
    strong = np.flatnonzero(power[3:] > 0.1 * power[3:].max())
    lowest = (int(strong[0]) + 3) if strong.size else 3
    return int(np.clip(u.size // lowest, 10, u.size // 8))


def over_time(cause: Shown, data: FitData) -> Picture | None:
    curves = tuple(Curve(role, *envelope(data.t_s, r)) for role, r in residuals(cause))
    return Picture("time / s", f"residual / {residual_unit(cause)[1]}", curves)


def slowly(cause: Shown, data: FitData) -> Picture | None:
    """For a drift: the mean residual over a period of the drive, over time."""
    width = slowest_period(data)
    cut = slice(width // 2, data.n - width // 2)
    curves = tuple(
        Curve(role, *envelope(data.t_s[cut], moving_mean(r, width)[cut], 1500)) for role, r in residuals(cause)
    )
    return Picture("time / s", f"mean residual over {width * data.dt_s:.3g} s / {residual_unit(cause)[1]}", curves)


def over_log_time(cause: Shown, data: FitData) -> Picture | None:
    """For creep: the residual after a step over the logarithm of time, for each long hold; else since the start."""
    still = np.abs(np.diff(data.u_V, prepend=data.u_V[0])) < 1e-9 * max(data.swing_V, 1e-12)
    # A hold at the beginning of the record follows no step.
    holds = [e for e in runs(still) if e[0] > 0 and (e[1] - e[0]) * data.dt_s > 0.5]
    long = sorted(holds, key=lambda e: e[0] - e[1])[:4]
    curves: list[Curve] = []
    if not long:
        width = slowest_period(data)
        where = np.unique(np.geomspace(width, data.n - width // 2 - 1, 80).astype(int))
        for role, r in residuals(cause):
            mean = moving_mean(r, width)[where]
            curves.append(Curve(role, where * data.dt_s, mean - mean[-1]))
        name = f"mean residual over {width * data.dt_s:.3g} s, less its last / {residual_unit(cause)[1]}"
        return Picture("time since the record began / s", name, tuple(curves), log_x=True)
    for role, r in residuals(cause):
        for i, (start, stop) in enumerate(long):
            where = np.unique(np.geomspace(max(2, round(0.02 / data.dt_s)), stop - start - 1, 60).astype(int))
            ends = np.minimum(where + np.maximum(1, where // 8), stop - start)
            sums = np.concatenate([[0.0], np.cumsum(r[start:stop])])
            mean = (sums[ends] - sums[where]) / (ends - where)
            # Creep continues in the direction of the step: make it positive.
            before = max(0, int(start) - 2)
            sign = float(np.sign(data.u_V[start] - data.u_V[before])) or 1.0
            note = f"hold at {data.u_V[start]:.3g} V"
            curves.append(Curve(role, where * data.dt_s, sign * (mean - mean[0]), note, dashed=i > 0))
    name = f"residual in the step's direction since 20 ms / {residual_unit(cause)[1]}"
    return Picture("time since the step / s", name, tuple(curves), log_x=True)


def _by_stretch(cause: Shown, data: FitData, of: FloatArray, least: float, scale: float, name: str) -> Picture:
    """Slope of the residual over ``of`` in about forty stretches of the record."""
    stretch = max(50, data.n // 40)
    curves = []
    for role, r in ((WITHOUT, cause.before_um), (WITH, cause.after_um)):
        t, slope = [], []
        for start in range(0, data.n - stretch + 1, stretch):
            x = of[start : start + stretch]
            d = x - x.mean()
            if float(d @ d) > least * stretch:
                t.append((start + 0.5 * stretch) * data.dt_s)
                slope.append(scale * float(d @ r[start : start + stretch]) / float(d @ d))
        curves.append(Curve(role, np.array(t), np.array(slope), points=True))
    return Picture("time / s", name, tuple(curves))


def gain_over_time(cause: Shown, data: FitData) -> Picture | None:
    least = (0.02 * data.range_um) ** 2
    return _by_stretch(cause, data, data.y_um, least, 100.0, "gain beyond the model's / %")


def lag_over_time(cause: Shown, data: FitData) -> Picture | None:
    v = np.gradient(data.y_um, data.dt_s)
    return _by_stretch(cause, data, v, 0.01 * float(np.var(v)), -1e6, "readings late by / µs")


def after_steps(cause: Shown, data: FitData) -> Picture | None:
    """For lags: the mean residual after the largest steps of the drive; without steps, over the speed."""
    du = np.diff(data.u_V, prepend=data.u_V[0])
    span = max(8, min(round(0.03 / data.dt_s), data.n // 20))
    order = np.argsort(-np.abs(du))[:20]
    usual = float(np.quantile(np.abs(du), 0.98))
    steps = [k for k in order if abs(du[k]) > max(0.05 * data.swing_V, 5.0 * usual) and 2 <= k < data.n - span]
    if len(steps) >= 2:
        t = np.asarray((np.arange(span + 2) - 2) * data.dt_s * 1e3, dtype=np.float64)
        curves = tuple(
            Curve(role, t, _mean([r[k - 2 : k + span] * np.sign(du[k]) for k in steps]), points=True)
            for role, r in residuals(cause)
        )
        return Picture(
            "time since the step / ms", f"mean residual in the step's direction / {residual_unit(cause)[1]}", curves
        )
    speed = np.gradient(data.y_um - cause.after_um, data.dt_s)
    curves = tuple(Curve(role, *binned(speed, r, 40)) for role, r in residuals(cause))
    return Picture("speed / (µm/s)", f"mean residual / {residual_unit(cause)[1]}", curves)


def _mean(rows: list[FloatArray]) -> FloatArray:
    return np.asarray(np.mean(rows, axis=0), dtype=np.float64)


def after_reversals(cause: Shown, data: FitData) -> Picture | None:
    """For friction: the residual in the direction of motion, over the distance since the last reversal."""
    x = data.y_um - cause.after_um
    way = np.sign(np.diff(x, prepend=x[0]))
    turns = np.flatnonzero(way[1:] * way[:-1] < 0) + 1
    if turns.size < 2:
        return None
    last = np.zeros(data.n, dtype=np.intp)
    last[turns] = turns
    last = np.maximum.accumulate(last)
    travelled = np.abs(x - x[last])
    near = (travelled > 0.0) & (travelled < 0.05 * data.range_um) & (last > 0)
    if near.sum() < 200:
        return None
    curves = tuple(Curve(role, *binned(travelled[near], (r * way)[near])) for role, r in residuals(cause))
    return Picture(
        "way since the reversal / µm", f"residual in the direction of motion / {residual_unit(cause)[1]}", curves
    )


def at_rest(cause: Shown, data: FitData) -> Picture | None:
    """For quantisation: single readings at rest, which show the grid."""
    quiet = np.flatnonzero(data.standing(0.1))
    start = int(quiet[0]) if quiet.size else 0
    part = slice(start, min(data.n, start + 400))
    y = data.y_um[part]
    step = cause.parameters.get("step_um", 0.0)
    origin = float(y[0])
    name = f"reading / steps of {1e3 * step:.3g} nm" if step > 0.0 else "reading / nm"
    scale = 1.0 / step if step > 0.0 else 1e3
    return Picture("time / s", name, (Curve(MEASURED, data.t_s[part], scale * (y - origin), points=True),))


def over_signal(cause: Shown, data: FitData, x: FloatArray, name: str) -> Picture | None:
    """Mean residual over ``x``, separately for rising and falling voltage."""
    rising = np.gradient(data.u_V)
    eps = 1e-6 * data.swing_V
    curves = []
    for role, r in residuals(cause):
        for mask, way, dashed in ((rising > eps, "rising", False), (rising < -eps, "falling", True)):
            if mask.sum() > 100:
                curves.append(Curve(role, *binned(x[mask], r[mask]), note=way, dashed=dashed))
    return Picture(name, f"mean residual / {residual_unit(cause)[1]}", tuple(curves)) if curves else None


def over_reading(cause: Shown, data: FitData) -> Picture | None:
    return over_signal(cause, data, data.y_um, "reading / µm")


def over_motion(cause: Shown, data: FitData) -> Picture | None:
    """The missing loop over the displacement. Near a resonance the voltage does not give the direction of motion."""
    x = data.y_um - cause.after_um
    speed = np.gradient(x)
    curves = []
    for role, r in residuals(cause):
        for mask, way, dashed in ((speed > 0.0, "rising", False), (speed < 0.0, "falling", True)):
            if mask.sum() > 100:
                curves.append(Curve(role, *binned(x[mask], r[mask], 40), note=way, dashed=dashed))
    return Picture("displacement / µm", f"mean residual / {residual_unit(cause)[1]}", tuple(curves)) if curves else None


def over_voltage(cause: Shown, data: FitData) -> Picture | None:
    return over_signal(cause, data, data.u_V, "voltage / V")


def over_rate(cause: Shown, data: FitData) -> Picture | None:
    """Loop width beyond the model's, over the rate of the voltage."""
    rate, sign = data.rate_V_per_s, np.sign(np.gradient(data.u_V))
    moving: BoolArray = np.asarray(rate > 1e-3 * data.swing_V / data.duration_s)
    if moving.sum() < 200:
        return None
    curves = []
    for role, r in residuals(cause):
        x, y = binned(np.log10(rate[moving]), -2.0 * (r * sign)[moving], 25)
        curves.append(Curve(role, 10.0**x, y))
    return Picture(
        "rate of the voltage / (V/s)",
        f"loop width beyond the model's / {residual_unit(cause)[1]}",
        tuple(curves),
        log_x=True,
    )


def frequency_response(cause: Shown, data: FitData) -> Picture | None:
    """Frequency response from voltage to reading: measured, and of the model without and with the cause."""
    from scipy.signal import csd, welch

    # Several segments, so that averaging reduces the variance.
    size = max(256, min(data.n // 8, round(2.0 / data.dt_s)))
    u = data.u_V - data.u_V.mean()
    rate = 1.0 / data.dt_s
    f, power = welch(u, rate, nperseg=size)
    driven = power > 1e-3 * power.max()
    driven[0] = False
    if driven.sum() < 8:
        return None
    curves = []
    y = data.y_um - data.y_um.mean()
    for role, r in ((MEASURED, np.zeros_like(y)), (WITHOUT, cause.before_um), (WITH, cause.after_um)):
        _, cross = csd(u, y - r, rate, nperseg=size)
        curves.append(Curve(role, f[driven], np.abs(cross[driven]) / power[driven]))
    marks = tuple(v for v in _modes(cause) if f[driven][0] < v < f[driven][-1])
    return Picture("frequency / Hz", "gain / (µm/V)", tuple(curves), log_x=True, log_y=True, marks=marks)


def _modes(cause: Shown) -> tuple[float, ...]:
    """Frequencies (Hz) of the modes of this cause."""
    return tuple(float(v) for name, v in cause.parameters.items() if name.startswith("f0") and name.endswith("_hz"))


def residual_spectrum(cause: Shown, data: FitData) -> Picture | None:
    from scipy.signal import welch

    modes = _modes(cause)
    size = max(256, min(data.n // (8 if modes else 1), round(4.0 / data.dt_s)))
    curves = []
    for role, r in residuals(cause):
        f, power = welch(r, 1.0 / data.dt_s, nperseg=size)
        curves.append(Curve(role, f[1:], np.sqrt(power[1:])))
    mark = cause.parameters.get("frequency_hz")
    marks = modes or ((float(mark),) if mark else ())
    return Picture(
        "frequency / Hz",
        f"residual / ({residual_unit(cause)[1]}/√Hz)",
        tuple(curves),
        log_y=True,
        marks=marks,
    )


def over_other_axis(cause: Shown, data: FitData) -> Picture | None:
    if _modes(cause):
        return residual_spectrum(cause, data)
    if data.other_um is None:
        return None
    curves = tuple(Curve(role, *binned(data.other_um, r)) for role, r in residuals(cause))
    return Picture("displacement of the other axis / µm", f"mean residual / {residual_unit(cause)[1]}", curves)


#: Draws the picture of a cause; None where it cannot be drawn.
Draw = Callable[[Shown, FitData], Picture | None]
