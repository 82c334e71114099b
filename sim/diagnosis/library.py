"""The calibrated nominal stage and each fitted cause in the effects library's own terms."""

from __future__ import annotations

import numpy as np

from adaptive.types import FloatArray
from sim.diagnosis.causes_restoring import RestoringLoop
from sim.diagnosis.fit import Fit
from sim.diagnosis.forms import Form
from sim.diagnosis.nominal import loop_numbers
from sim.diagnosis.nominal_stage import StageNominal
from sim.diagnosis.setting import Setting
from sim.effects import KINDS, Effect, effect

#: Label of the effect that carries the sensor's offset.
OFFSET = "sensor_offset"


def _clip(name: str, **values: float) -> dict[str, float]:
    kind = KINDS[name]
    return {key: float(np.clip(v, kind.parameter(key).low, kind.parameter(key).high)) for key, v in values.items()}


def make(name: str, label: str = "", **values: float) -> Effect:
    return effect(name, label=label, **_clip(name, **values))


def nominal_effects(fit: Fit) -> list[Effect]:
    """The calibrated nominal stage in the library's effects. The recorder's latch is no part of the stage."""
    p = fit.model.part(fit.p, -1)
    nominal = fit.model.nominal
    # After the mechanics: an offset before them would be travelled to, lag and all, from a start at zero.
    drift = {"amplitude_um": 0.0, "ramp_um_per_min": 0.0, "walk_um_per_sqrt_min": 0.0}
    offset = make("thermal_drift", OFFSET, offset_um=nominal.offset_um(p), **drift)
    if isinstance(nominal, StageNominal):
        return [*nominal.effects(p), offset]
    if nominal.name == "linear":
        f, z = float(np.exp(p[1])), float(np.exp(p[2]))
        return [
            make("linear_actuator", gain_um_per_V=float(p[0])),
            offset,
            make("resonance", label="nominal_mode", frequency_Hz=f, damping_ratio=z),
        ]
    slope, beta, gamma = loop_numbers(p)
    d = float(p[0])
    k = KINDS["mechanics"].parameter("stiffness_N_per_m").default
    return [
        make("bouc_wen", d_um_per_V=d, alpha=slope / d, beta_per_V=beta, gamma_per_V=gamma),
        offset,
        make("mechanics", damping_N_s_per_m=float(p[4]) * k, stiffness_N_per_m=k),
    ]


def cause_effects(form: Form, p: FloatArray, setting: Setting) -> tuple[list[Effect], bool]:
    """One fitted cause in the library's effects, and whether their numbers still want fitting."""
    v = {name: value for name, (value, _) in form.physical(p, setting).items()}
    swing, duration = setting.swing_V, setting.duration_s
    match form.name:
        case "amplifier_lag" | "sensor_lag":
            return [make(form.name, tau_s=v["tau_s"])], False
        case "slew_limit":
            return [make("slew_limit", rate_V_per_s=v["slew_V_per_s"])], False
        case "saturation":
            return [make("saturation", high_V=v["u_max_V"], low_V=min(v["u_min_V"], 0.0) - 1e-3 * swing)], False
        case "delay":
            return [make("delay", delay_s=v["tau_s"])], False
        case "resonance":
            return [make("resonance", frequency_Hz=v["f0_hz"], damping_ratio=v["damping"])], False
        case "payload_change":
            return [make("payload_change", payload_ratio=v["payload_ratio"])], False
        case "creep":
            return [make("creep", gain_per_decade=v["gain_per_decade"])], True
        case "cross_talk":
            if form.variant == "modes":
                return [], False
            return [make("cross_talk", static=v["static"], rate_s=v["rate_s"])], False
        case "mains_hum":
            phase = float(np.arctan2(p[2], p[1]) / (2.0 * np.pi))
            return [
                make(
                    "mains_hum",
                    amplitude_um=v["amplitude_um"],
                    frequency_Hz=v["frequency_hz"],
                    phase_cycles=phase,
                    third_share=float(np.hypot(*p[-2:]) / max(v["amplitude_um"], 1e-12)) if p.size >= 7 else 0.0,
                )
            ], False
        case "timing":
            return [make("timing", repeat_probability=0.0, slow_ppm=max(0.0, -v["clock_ppm"]))], False
        case "stick_slip":
            return [make("stick_slip", width_um=v["width_um"], sliding_share=v["sliding_share"])], False
        case "thermal_drift":
            ramp = 60.0 * float(p[-1]) / duration if form.variant != "temperature" else 0.0
            tau = 0.3 * duration
            return [make("thermal_drift", amplitude_um=1e-3, tau_s=tau, ramp_um_per_min=ramp)], True
        case "gain_drift":
            ramp = 60.0 * float(p[-1]) / duration if form.variant != "temperature" else 0.0
            tau = 0.3 * duration
            return [make("gain_drift", ramp_per_min=ramp, amplitude=1e-4, tau_s=tau)], True
        case "sensor_nonlinearity":
            return [
                make("sensor_nonlinearity", square=v["quadratic"], cubic=v["cubic"], range_um=setting.range_um)
            ], True
        case "asymmetry":
            slope = v["bend"] * setting.range_um / swing
            where = setting.u_low_V
            return [
                make(
                    "asymmetry",
                    "asymmetry",
                    slope_um_per_V=slope,
                    dead_zone_V=where + 0.35 * swing,
                    threshold_V=0.02 * swing,
                ),
                make(
                    "asymmetry",
                    "asymmetry_2",
                    slope_um_per_V=0.1 * slope,
                    dead_zone_V=where + 0.65 * swing,
                    threshold_V=0.15 * swing,
                ),
            ], True
        case "rate_dependence":
            return [
                make(
                    "rate_dependence",
                    growth_per_decade=0.1,
                    corner_V_per_s=v["corner_V_per_s"],
                    width_um=0.1 * setting.range_um,
                    largest_V=0.35 * swing,
                )
            ], True
        case "hysteresis_shape":
            width = 0.05 * setting.range_um
            return [
                make("hysteresis_shape", "hysteresis_shape", width_um=width, largest_V=0.5 * swing, fading=1.0),
                make(
                    "hysteresis_shape", "hysteresis_shape_2", width_um=0.2 * width, largest_V=0.15 * swing, fading=1.0
                ),
            ], True
    return [], False


def in_force(e: Effect, form: RestoringLoop, p: FloatArray, setting: Setting) -> Effect:
    """A mode of the nominal stage with the loop in its restoring force; any other effect as it is."""
    if e.name != "resonance":
        return e
    v = {name: value for name, (value, _) in form.physical(p, setting).items()}
    mode = {name: e.values[name] for name in ("frequency_Hz", "damping_ratio")}
    return make("mechanical_hysteresis", e.label, **mode, **v)
