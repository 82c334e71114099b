"""True values of the numbers that the diagnosis reports, as far as a case has a counterpart of them."""

from __future__ import annotations

import numpy as np

from tests.hidden.foreign.effects import creep_law
from tests.hidden.foreign.record import Case

#: Cause to reported number to the values that count as true. More than one where the record cannot tell them apart.
TrueNumbers = dict[str, dict[str, tuple[float, ...]]]


def _creep_per_decade(case: Case) -> float:
    """Slope of the step response over log10 t between 0.1 s and half the record, which is what is reported."""
    own = case.effects["creep"]
    t = np.logspace(-1.0, np.log10(0.5 * case.rig.duration_s), 60)
    return float(np.polyfit(np.log10(t), creep_law(t, own["share"], own["power"]), 1)[0])


def _timing(own: dict[str, float]) -> dict[str, tuple[float, ...]]:
    if "ppm" in own:
        return {"clock_ppm": (own["ppm"],)}
    if "rows" in own:
        return {"lost_samples": (own["rows"],)}
    return {"lost_samples": (own["slips"] * own["sign"],)}


def _pole(f_hz: float, damping: float, fs_hz: float) -> complex:
    """The pole that the generator's trapezoidal rule with its pre-warped frequency gives a mode, in rad/s.

    The rule keeps the frequency, but not the damping: at a tenth of ``fs_hz`` it damps 6 % less than was stated.
    """
    warped = 2.0 * fs_hz * np.tan(np.pi * f_hz / fs_hz) * complex(-damping, np.sqrt(1.0 - damping**2))
    return complex(2.0 * fs_hz * np.arctanh(warped / (2.0 * fs_hz)))


def true_numbers(case: Case) -> TrueNumbers:
    """Counterparts for causes whose reported number has the same meaning here. Others (weights of plays, bends of a
    curve in the diagnosis' own polynomials, growth per decade of another law) have none."""
    out: TrueNumbers = {}
    rig = case.rig
    for name, own in case.effects.items():
        match name:
            case "creep":
                out[name] = {"gain_per_decade": (_creep_per_decade(case),)}
            case "thermal_drift":
                out[name] = {"rate_um_per_s": (own["total_um"] / rig.duration_s,)}
            case "gain_drift":
                out[name] = {"gain": (own["total"],)}
            case "resonance":
                if "second_Hz" not in own:
                    pole = _pole(own["f_Hz"], own["damping"], rig.fs_hz * rig.over)
                    out[name] = {"f0_hz": (abs(pole) / (2.0 * np.pi),), "damping": (-pole.real / abs(pole),)}
            case "payload_change":
                # Its moment has no counterpart: during a rest nothing shows it.
                out[name] = {"payload_ratio": (own["ratio"],)}
            case "amplifier_lag" | "sensor_lag":
                # Behind a weak loop the stage's own lag and this one may change places.
                out[name] = {"tau_s": (own["tau_s"], rig.lag_s)}
            case "slew_limit":
                out[name] = {"slew_V_per_s": (own["rate_V_per_s"],)}
            case "saturation":
                out[name] = {"u_max_V": (own["top_V"],)}
            case "delay":
                # Dead time from the voltage to the reading, so the early reading is a part of it.
                fine = rig.fs_hz * rig.over
                out[name] = {"tau_s": ((round(own["tau_s"] * fine) + rig.early_steps) / fine,)}
            case "cross_talk":
                out[name] = {"static": (own["share"],)}
            case "mains_hum":
                out[name] = {"frequency_hz": (own["f_Hz"],), "amplitude_um": (own["amplitude_um"],)}
            case "quantisation":
                out[name] = {"step_um": (own["step_um"],)}
            case "timing":
                out[name] = _timing(own)
    return out
