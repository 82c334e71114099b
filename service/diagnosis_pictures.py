"""Pictures of a diagnosis, drawn without a display: the residual before and after, and each cause's own picture."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from adaptive.types import FloatArray
from sim.diagnosis.noise import standing
from sim.diagnosis.result import Cause, Diagnosis
from sim.diagnosis.setting import Setting

BEFORE, AFTER, DRIVE, FLOOR = "#D55E00", "#0072B2", "#666666", "#BBBBBB"
#: Points beyond which a line is drawn by the extremes of equal stretches.
MOST_POINTS = 6000


def _figure(rows: int, height: float) -> tuple[Any, Any]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, height), layout="constrained", dpi=110)
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, 1, squeeze=False)[:, 0]


def _envelope(t: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """A long line thinned to the lowest and highest value of each stretch, so that no spike is lost."""
    if y.size <= MOST_POINTS:
        return t, y
    width = -(-y.size // (MOST_POINTS // 2))
    starts = np.arange(0, y.size, width)
    low, high = np.minimum.reduceat(y, starts), np.maximum.reduceat(y, starts)
    return np.repeat(t[starts], 2), np.column_stack([low, high]).ravel()


def draw_residual(path: Path, diagnosis: Diagnosis, title: str) -> None:
    """Voltage, and the residual of the nominal and of the extended model over time."""
    setting = diagnosis.nominal.model.setting
    figure, axes = _figure(3, 7.5)
    axes[0].plot(*_envelope(setting.t_s, setting.u_V), color=DRIVE, lw=0.7)
    axes[0].set_ylabel("voltage / V")
    axes[0].set_title(title)
    pairs = (
        (diagnosis.nominal.residual_um, BEFORE, f"nominal stage, held out {_nm(diagnosis.nominal_heldout_um)}"),
        (diagnosis.extended.residual_um, AFTER, f"extended stage, held out {_nm(diagnosis.extended_heldout_um)}"),
    )
    for axis, (residual, colour, label) in zip(axes[1:], pairs, strict=True):
        axis.axhspan(-2e3 * diagnosis.noise_floor_um, 2e3 * diagnosis.noise_floor_um, color=FLOOR, alpha=0.5, lw=0)
        axis.plot(*_envelope(setting.t_s, 1e3 * residual), color=colour, lw=0.6, label=label)
        # A first moment that nothing knows must not flatten the rest.
        limit = 1.3 * float(np.quantile(np.abs(1e3 * residual), 0.999))
        axis.set_ylim(-max(limit, 1e-3), max(limit, 1e-3))
        axis.set_ylabel("residual / nm")
        axis.legend(loc="upper right")
    axes[-1].set_xlabel("time / s (grey: twice the noise floor)")
    figure.savefig(path)


def _nm(value_um: float) -> str:
    return f"{1e3 * value_um:.3g} nm" if value_um < 1.0 else f"{value_um:.3g} µm"


def draw_cause(path: Path, cause: Cause, diagnosis: Diagnosis) -> None:
    """The picture in which this cause shows itself: before (without it) and after (with it)."""
    setting = diagnosis.extended.model.setting
    draw = _PICTURES.get(cause.name, _over_time)
    figure, axes = _figure(1, 4.5)
    for residual, colour, label in ((cause.before_um, BEFORE, "without it"), (cause.after_um, AFTER, "with it")):
        draw(axes[0], setting, 1e3 * residual, colour, label)
    axes[0].set_title(f"{cause.name}: what is left of the readings without it and with it")
    axes[0].legend(loc="best")
    figure.savefig(path)


def _over_time(axis: Any, setting: Setting, r_nm: FloatArray, colour: str, label: str) -> None:
    axis.plot(*_envelope(setting.t_s, r_nm), color=colour, lw=0.6, label=label)
    axis.set(xlabel="time / s", ylabel="residual / nm")


def _over_log_time(axis: Any, setting: Setting, r_nm: FloatArray, colour: str, label: str) -> None:
    """Holds after each step, over the logarithm of the time since."""
    still = np.abs(np.diff(setting.u_V, prepend=setting.u_V[0])) < 1e-9 * max(setting.swing_V, 1e-12)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(np.int8))).reshape(-1, 2)
    long = sorted((e for e in edges if (e[1] - e[0]) * setting.dt_s > 0.5), key=lambda e: e[0] - e[1])[:4]
    if not long:
        _over_time(axis, setting, r_nm, colour, label)
        return
    for i, (start, stop) in enumerate(long):
        where = np.unique(np.geomspace(max(2, round(0.02 / setting.dt_s)), stop - start - 1, 60).astype(int))
        width = np.maximum(1, where // 8)
        sums = np.concatenate([[0.0], np.cumsum(r_nm[start:stop])])
        mean = (sums[np.minimum(where + width, stop - start)] - sums[where]) / (
            np.minimum(where + width, stop - start) - where
        )
        axis.plot(
            where * setting.dt_s,
            mean - mean[0],
            color=colour,
            marker=".",
            ms=3,
            lw=0.9,
            label=label if i == 0 else None,
        )
    axis.set(xscale="log", xlabel="time since the step / s", ylabel="residual since 20 ms / nm")


def _binned(x: FloatArray, y: FloatArray, bins: int = 60) -> tuple[FloatArray, FloatArray]:
    low, high = np.quantile(x, [0.001, 0.999])
    edges = np.linspace(low, high, bins + 1)
    place = np.clip(np.digitize(x, edges) - 1, 0, bins - 1)
    count = np.bincount(place, minlength=bins)
    mean = np.bincount(place, weights=y, minlength=bins) / np.maximum(count, 1)
    good = count > 20
    return 0.5 * (edges[1:] + edges[:-1])[good], mean[good]


def _over_reading(axis: Any, setting: Setting, r_nm: FloatArray, colour: str, label: str) -> None:
    rising = np.gradient(setting.u_V) > 0.0
    for mask, style, way in ((rising, "-", "rising"), (~rising, "--", "falling")):
        if mask.sum() > 100:
            axis.plot(*_binned(setting.y_um[mask], r_nm[mask]), style, color=colour, label=f"{label}, {way}")
    axis.set(xlabel="reading / µm", ylabel="mean residual / nm")


def _over_voltage(axis: Any, setting: Setting, r_nm: FloatArray, colour: str, label: str) -> None:
    stride = max(1, setting.n // MOST_POINTS)
    axis.plot(setting.u_V[::stride], r_nm[::stride], ".", ms=1.5, color=colour, label=label)
    axis.set(xlabel="voltage / V", ylabel="residual / nm")


def _over_rate(axis: Any, setting: Setting, r_nm: FloatArray, colour: str, label: str) -> None:
    rate = setting.rate_V_per_s
    moving = rate > 1e-6 * setting.swing_V
    if moving.sum() < 200:
        _over_time(axis, setting, r_nm, colour, label)
        return
    sign = np.sign(np.gradient(setting.u_V))
    axis.plot(*_binned(np.log10(rate[moving]), (r_nm * sign)[moving], 30), "o-", ms=3, color=colour, label=label)
    axis.set(xlabel="log10 of the voltage rate / (V/s)", ylabel="residual in the direction of motion / nm")


def _over_frequency(axis: Any, setting: Setting, r_nm: FloatArray, colour: str, label: str) -> None:
    from scipy.signal import welch

    f, power = welch(r_nm, 1.0 / setting.dt_s, nperseg=min(setting.n, max(256, round(2.0 / setting.dt_s))))
    axis.semilogy(f[1:], np.sqrt(power[1:]), color=colour, lw=0.8, label=label)
    axis.set(xlabel="frequency / Hz", ylabel="residual / (nm/√Hz)")


def _over_other_axis(axis: Any, setting: Setting, r_nm: FloatArray, colour: str, label: str) -> None:
    if setting.other_um is None:
        _over_time(axis, setting, r_nm, colour, label)
        return
    axis.plot(*_binned(setting.other_um, r_nm), color=colour, label=label)
    axis.set(xlabel="displacement of the other axis / µm", ylabel="mean residual / nm")


def _gain_over_time(axis: Any, setting: Setting, r_nm: FloatArray, colour: str, label: str) -> None:
    """Slope of the residual over the displacement, stretch by stretch."""
    stretch = max(50, setting.n // 40)
    t, g = [], []
    for start in range(0, setting.n - stretch, stretch):
        y, r = setting.y_um[start : start + stretch], r_nm[start : start + stretch]
        spread = float(np.var(y))
        if spread > (0.02 * setting.range_um) ** 2:
            t.append((start + 0.5 * stretch) * setting.dt_s)
            g.append(1e-3 * float(np.mean((y - y.mean()) * (r - r.mean()))) / spread)
    axis.plot(t, 100.0 * np.array(g), "o-", ms=3, color=colour, label=label)
    axis.set(xlabel="time / s", ylabel="gain error / %")


def _lag_over_time(axis: Any, setting: Setting, r_nm: FloatArray, colour: str, label: str) -> None:
    """The time by which the readings are early or late, stretch by stretch."""
    stretch = max(50, setting.n // 40)
    v = np.gradient(setting.y_um, setting.dt_s)
    t, late = [], []
    for start in range(0, setting.n - stretch, stretch):
        part = slice(start, start + stretch)
        power = float(v[part] @ v[part])
        if power > 1e-4 * float(v @ v):
            t.append((start + 0.5 * stretch) * setting.dt_s)
            late.append(-1e-3 * float(v[part] @ r_nm[part]) / power)
    axis.plot(t, 1e6 * np.array(late), "o-", ms=3, color=colour, label=label)
    axis.set(xlabel="time / s", ylabel="readings late by / µs")


def _after_steps(axis: Any, setting: Setting, r_nm: FloatArray, colour: str, label: str) -> None:
    """The mean residual after the largest steps of the drive, per micrometre of motion."""
    du = np.diff(setting.u_V, prepend=setting.u_V[0])
    span = max(8, min(round(0.03 / setting.dt_s), setting.n // 20))
    order = np.argsort(-np.abs(du))[:20]
    pieces = [
        r_nm[k - 2 : k + span] * np.sign(du[k])
        for k in order
        if abs(du[k]) > 0.02 * setting.swing_V and 2 <= k < setting.n - span
    ]
    if len(pieces) < 2:
        _over_frequency(axis, setting, r_nm, colour, label)
        return
    axis.plot((np.arange(span + 2) - 2) * setting.dt_s * 1e3, np.mean(pieces, axis=0), ".-", color=colour, label=label)
    axis.set(xlabel="time since the step / ms", ylabel="mean residual in the step's direction / nm")


def _at_rest(axis: Any, setting: Setting, r_nm: FloatArray, colour: str, label: str) -> None:
    """A stretch at rest, reading by reading."""
    if label == "with it":
        return
    quiet = np.flatnonzero(standing(setting, 0.1))
    start = int(quiet[0]) if quiet.size else 0
    part = slice(start, min(setting.n, start + 400))
    y = setting.y_um[part]
    axis.plot(
        setting.t_s[part], 1e3 * (y - y.mean()), drawstyle="steps-post", color=colour, lw=0.8, label="readings at rest"
    )
    axis.set(xlabel="time / s", ylabel="reading / nm")


_PICTURES: dict[str, Callable[[Any, Setting, FloatArray, str, str], None]] = {
    "creep": _over_log_time,
    "gain_drift": _gain_over_time,
    "resonance": _over_frequency,
    "payload_change": _over_frequency,
    "mains_hum": _over_frequency,
    "amplifier_lag": _after_steps,
    "sensor_lag": _after_steps,
    "delay": _after_steps,
    "slew_limit": _after_steps,
    "saturation": _over_voltage,
    "hysteresis_shape": _over_voltage,
    "stick_slip": _over_voltage,
    "asymmetry": _over_reading,
    "sensor_nonlinearity": _over_reading,
    "rate_dependence": _over_rate,
    "cross_talk": _over_other_axis,
    "quantisation": _at_rest,
    "timing": _lag_over_time,
}
