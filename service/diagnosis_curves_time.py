"""Pictures over time: since the record began, since a step, since a reversal, stretch by stretch."""

from __future__ import annotations

import numpy as np

from adaptive.types import FloatArray
from service.diagnosis_curve import MEASURED, WITH, WITHOUT, Curve, Picture, binned, both, envelope, period, slow, unit
from sim.diagnosis.noise import standing
from sim.diagnosis.result import Cause
from sim.diagnosis.setting import Setting


def over_time(cause: Cause, setting: Setting) -> Picture | None:
    curves = tuple(Curve(role, *envelope(setting.t_s, r)) for role, r in both(cause))
    return Picture("time / s", f"residual / {unit(cause)[1]}", curves)


def slowly(cause: Cause, setting: Setting) -> Picture | None:
    """A drift: the residual's mean over a period of the drive, over time."""
    width = period(setting)
    cut = slice(width // 2, setting.n - width // 2)
    curves = tuple(Curve(role, *envelope(setting.t_s[cut], slow(r, width)[cut], 1500)) for role, r in both(cause))
    return Picture("time / s", f"mean residual over {width * setting.dt_s:.3g} s / {unit(cause)[1]}", curves)


def over_log_time(cause: Cause, setting: Setting) -> Picture | None:
    """Creep: the residual after each long hold's step over the logarithm of time; without holds, since the start."""
    still = np.abs(np.diff(setting.u_V, prepend=setting.u_V[0])) < 1e-9 * max(setting.swing_V, 1e-12)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(np.int8))).reshape(-1, 2)
    # A hold after a step shows creep; one that the record begins with shows nothing.
    holds = [e for e in edges if e[0] > 0 and (e[1] - e[0]) * setting.dt_s > 0.5]
    long = sorted(holds, key=lambda e: e[0] - e[1])[:4]
    curves: list[Curve] = []
    if not long:
        width = period(setting)
        where = np.unique(np.geomspace(width, setting.n - width // 2 - 1, 80).astype(int))
        for role, r in both(cause):
            mean = slow(r, width)[where]
            curves.append(Curve(role, where * setting.dt_s, mean - mean[-1]))
        name = f"mean residual over {width * setting.dt_s:.3g} s, less its last / {unit(cause)[1]}"
        return Picture("time since the record began / s", name, tuple(curves), log_x=True)
    for role, r in both(cause):
        for i, (start, stop) in enumerate(long):
            where = np.unique(np.geomspace(max(2, round(0.02 / setting.dt_s)), stop - start - 1, 60).astype(int))
            ends = np.minimum(where + np.maximum(1, where // 8), stop - start)
            sums = np.concatenate([[0.0], np.cumsum(r[start:stop])])
            mean = (sums[ends] - sums[where]) / (ends - where)
            # Up and down alike: creep goes on in the direction of the step.
            before = max(0, int(start) - 2)
            sign = float(np.sign(setting.u_V[start] - setting.u_V[before])) or 1.0
            note = f"hold at {setting.u_V[start]:.3g} V"
            curves.append(Curve(role, where * setting.dt_s, sign * (mean - mean[0]), note, dashed=i > 0))
    name = f"residual in the step's direction since 20 ms / {unit(cause)[1]}"
    return Picture("time since the step / s", name, tuple(curves), log_x=True)


def _by_stretch(cause: Cause, setting: Setting, of: FloatArray, least: float, scale: float, name: str) -> Picture:
    """Slope of the residual over ``of`` in forty stretches of the record."""
    stretch = max(50, setting.n // 40)
    curves = []
    for role, r in ((WITHOUT, cause.before_um), (WITH, cause.after_um)):
        t, slope = [], []
        for start in range(0, setting.n - stretch + 1, stretch):
            x = of[start : start + stretch]
            d = x - x.mean()
            if float(d @ d) > least * stretch:
                t.append((start + 0.5 * stretch) * setting.dt_s)
                slope.append(scale * float(d @ r[start : start + stretch]) / float(d @ d))
        curves.append(Curve(role, np.array(t), np.array(slope), points=True))
    return Picture("time / s", name, tuple(curves))


def gain_over_time(cause: Cause, setting: Setting) -> Picture | None:
    least = (0.02 * setting.range_um) ** 2
    return _by_stretch(cause, setting, setting.y_um, least, 100.0, "gain beyond the model's / %")


def lag_over_time(cause: Cause, setting: Setting) -> Picture | None:
    v = np.gradient(setting.y_um, setting.dt_s)
    return _by_stretch(cause, setting, v, 0.01 * float(np.var(v)), -1e6, "readings late by / µs")


def after_steps(cause: Cause, setting: Setting) -> Picture | None:
    """The mean residual after the largest steps of the drive; without steps, over the speed: late is a slope."""
    du = np.diff(setting.u_V, prepend=setting.u_V[0])
    span = max(8, min(round(0.03 / setting.dt_s), setting.n // 20))
    order = np.argsort(-np.abs(du))[:20]
    usual = float(np.quantile(np.abs(du), 0.98))
    steps = [k for k in order if abs(du[k]) > max(0.05 * setting.swing_V, 5.0 * usual) and 2 <= k < setting.n - span]
    if len(steps) >= 2:
        t = np.asarray((np.arange(span + 2) - 2) * setting.dt_s * 1e3, dtype=np.float64)
        curves = tuple(
            Curve(role, t, _mean([r[k - 2 : k + span] * np.sign(du[k]) for k in steps]), points=True)
            for role, r in both(cause)
        )
        return Picture("time since the step / ms", f"mean residual in the step's direction / {unit(cause)[1]}", curves)
    speed = np.gradient(setting.y_um - cause.after_um, setting.dt_s)
    curves = tuple(Curve(role, *binned(speed, r, 40)) for role, r in both(cause))
    return Picture("speed / (µm/s)", f"mean residual / {unit(cause)[1]}", curves)


def _mean(rows: list[FloatArray]) -> FloatArray:
    return np.asarray(np.mean(rows, axis=0), dtype=np.float64)


def after_reversals(cause: Cause, setting: Setting) -> Picture | None:
    """Friction: the residual against the motion, over the way travelled since the last reversal."""
    x = setting.y_um - cause.after_um
    way = np.sign(np.diff(x, prepend=x[0]))
    turns = np.flatnonzero(way[1:] * way[:-1] < 0) + 1
    if turns.size < 2:
        return None
    last = np.zeros(setting.n, dtype=np.intp)
    last[turns] = turns
    last = np.maximum.accumulate(last)
    travelled = np.abs(x - x[last])
    near = (travelled > 0.0) & (travelled < 0.05 * setting.range_um) & (last > 0)
    if near.sum() < 200:
        return None
    curves = tuple(Curve(role, *binned(travelled[near], (r * way)[near])) for role, r in both(cause))
    return Picture("way since the reversal / µm", f"residual in the direction of motion / {unit(cause)[1]}", curves)


def at_rest(cause: Cause, setting: Setting) -> Picture | None:
    """Readings at rest, one by one: the grid they lie on."""
    quiet = np.flatnonzero(standing(setting, 0.1))
    start = int(quiet[0]) if quiet.size else 0
    part = slice(start, min(setting.n, start + 400))
    y = setting.y_um[part]
    step = cause.parameters.get("step_um", 0.0)
    origin = float(y[0])
    name = f"reading / steps of {1e3 * step:.3g} nm" if step > 0.0 else "reading / nm"
    scale = 1.0 / step if step > 0.0 else 1e3
    return Picture("time / s", name, (Curve(MEASURED, setting.t_s[part], scale * (y - origin), points=True),))
