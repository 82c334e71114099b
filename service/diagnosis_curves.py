"""Each cause's own picture, as curves: what is left of the readings without it and with it, over what shows it best.

Curves are numbers here, drawn elsewhere: into a PNG by `service.diagnosis_pictures`, for the viewer by
`service.diagnosis_viewer`.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from adaptive.types import BoolArray, FloatArray
from service.diagnosis_curve import MEASURED, WITH, WITHOUT, Curve, Picture, binned, both, unit
from service.diagnosis_curves_time import (
    after_reversals,
    after_steps,
    at_rest,
    gain_over_time,
    lag_over_time,
    over_log_time,
    over_time,
    slowly,
)
from sim.diagnosis.result import Cause
from sim.diagnosis.setting import Setting


def picture(cause: Cause, setting: Setting) -> Picture:
    """The picture in which this cause shows itself."""
    for attempt in (_PICTURES.get(cause.name, over_time), over_time):
        made = attempt(cause, setting)
        if made is not None:
            return made
    raise AssertionError("a residual over time can always be drawn")  # pragma: no cover


def _by_way(cause: Cause, setting: Setting, x: FloatArray, name: str) -> Picture | None:
    """Mean residual over ``x``, on the way up and on the way down apart."""
    rising = np.gradient(setting.u_V)
    eps = 1e-6 * setting.swing_V
    curves = []
    for role, r in both(cause):
        for mask, way, dashed in ((rising > eps, "rising", False), (rising < -eps, "falling", True)):
            if mask.sum() > 100:
                curves.append(Curve(role, *binned(x[mask], r[mask]), note=way, dashed=dashed))
    return Picture(name, f"mean residual / {unit(cause)[1]}", tuple(curves)) if curves else None


def _over_reading(cause: Cause, setting: Setting) -> Picture | None:
    return _by_way(cause, setting, setting.y_um, "reading / µm")


def _over_motion(cause: Cause, setting: Setting) -> Picture | None:
    """The loop that is missing, over the displacement; across a resonance the voltage tells nothing of the way."""
    x = setting.y_um - cause.after_um
    speed = np.gradient(x)
    curves = []
    for role, r in both(cause):
        for mask, way, dashed in ((speed > 0.0, "rising", False), (speed < 0.0, "falling", True)):
            if mask.sum() > 100:
                curves.append(Curve(role, *binned(x[mask], r[mask], 40), note=way, dashed=dashed))
    return Picture("displacement / µm", f"mean residual / {unit(cause)[1]}", tuple(curves)) if curves else None


def _over_voltage(cause: Cause, setting: Setting) -> Picture | None:
    return _by_way(cause, setting, setting.u_V, "voltage / V")


def _over_rate(cause: Cause, setting: Setting) -> Picture | None:
    """By how much the loop is wider than the model's, over the rate of the voltage."""
    rate, sign = setting.rate_V_per_s, np.sign(np.gradient(setting.u_V))
    moving: BoolArray = np.asarray(rate > 1e-3 * setting.swing_V / setting.duration_s)
    if moving.sum() < 200:
        return None
    curves = []
    for role, r in both(cause):
        x, y = binned(np.log10(rate[moving]), -2.0 * (r * sign)[moving], 25)
        curves.append(Curve(role, 10.0**x, y))
    return Picture(
        "rate of the voltage / (V/s)", f"loop width beyond the model's / {unit(cause)[1]}", tuple(curves), log_x=True
    )


def _response(cause: Cause, setting: Setting) -> Picture | None:
    """Readings over voltage in the frequency domain: measured, and as the model has it without and with the cause."""
    from scipy.signal import csd, welch

    # Enough pieces to average over: one alone is all speckle.
    size = max(256, min(setting.n // 8, round(2.0 / setting.dt_s)))
    u = setting.u_V - setting.u_V.mean()
    rate = 1.0 / setting.dt_s
    f, power = welch(u, rate, nperseg=size)
    driven = power > 1e-3 * power.max()
    driven[0] = False
    if driven.sum() < 8:
        return None
    curves = []
    y = setting.y_um - setting.y_um.mean()
    for role, r in ((MEASURED, np.zeros_like(y)), (WITHOUT, cause.before_um), (WITH, cause.after_um)):
        _, cross = csd(u, y - r, rate, nperseg=size)
        curves.append(Curve(role, f[driven], np.abs(cross[driven]) / power[driven]))
    marks = tuple(v for v in _modes(cause) if f[driven][0] < v < f[driven][-1])
    # Little is driven far above the drive's own band; there the quotient is noise.
    return Picture("frequency / Hz", "gain / (µm/V)", tuple(curves), log_x=True, log_y=True, marks=marks)


def _modes(cause: Cause) -> tuple[float, ...]:
    """Frequencies of its modes, Hz."""
    return tuple(float(v) for name, v in cause.parameters.items() if name.startswith("f0") and name.endswith("_hz"))


def _spectrum(cause: Cause, setting: Setting) -> Picture | None:
    from scipy.signal import welch

    modes = _modes(cause)
    size = max(256, min(setting.n // (8 if modes else 1), round(4.0 / setting.dt_s)))
    curves = []
    for role, r in both(cause):
        f, power = welch(r, 1.0 / setting.dt_s, nperseg=size)
        curves.append(Curve(role, f[1:], np.sqrt(power[1:])))
    mark = cause.parameters.get("frequency_hz")
    marks = modes or ((float(mark),) if mark else ())
    return Picture(
        "frequency / Hz",
        f"residual / ({unit(cause)[1]}/√Hz)",
        tuple(curves),
        log_y=True,
        marks=marks,
    )


def _over_other_axis(cause: Cause, setting: Setting) -> Picture | None:
    if _modes(cause):
        return _spectrum(cause, setting)
    if setting.other_um is None:
        return None
    curves = tuple(Curve(role, *binned(setting.other_um, r)) for role, r in both(cause))
    return Picture("displacement of the other axis / µm", f"mean residual / {unit(cause)[1]}", curves)


_PICTURES: dict[str, Callable[[Cause, Setting], Picture | None]] = {
    "creep": over_log_time,
    "thermal_drift": slowly,
    "gain_drift": gain_over_time,
    "resonance": _response,
    "payload_change": _response,
    "mains_hum": _spectrum,
    "amplifier_lag": after_steps,
    "sensor_lag": after_steps,
    "delay": after_steps,
    "slew_limit": after_steps,
    "saturation": _over_voltage,
    "hysteresis_shape": _over_motion,
    "stick_slip": after_reversals,
    "asymmetry": _over_reading,
    "sensor_nonlinearity": _over_reading,
    "rate_dependence": _over_rate,
    "cross_talk": _over_other_axis,
    "quantisation": at_rest,
    "timing": lag_over_time,
}
