"""Seeded cases: which effect, how large, on which hysteresis; and which names are the same to this data."""

from __future__ import annotations

import numpy as np

from tests.hidden.excitation import excitation
from tests.hidden.stage import Truth, record

#: Causes that one voltage and one sensor cannot tell apart (with the catalogue), whatever the method.
INSEPARABLE: list[set[str]] = [
    {"amplifier_lag", "sensor_lag", "delay"},
]

#: Left out of the score, with the reason.
LEFT_OUT = {
    "payload_change": "the nominal Bouc-Wen stage has no mode that a payload could move; tests/sim has one that has",
    "hysteresis_shape": "scored with the many-play stage underneath, not as a hidden effect",
}


def _draw(name: str, rng: np.random.Generator) -> dict[str, float]:
    u = rng.uniform
    sign = float(rng.choice([-1.0, 1.0]))
    match name:
        case "creep":
            return {"per_decade": u(0.008, 0.02)}
        case "thermal_drift":
            return {"total_um": sign * u(0.2, 1.0), "tau_s": u(15.0, 60.0)}
        case "gain_drift":
            return {"total": sign * u(0.004, 0.02)}
        case "resonance":
            return {"f_Hz": u(300.0, 500.0), "damping": u(0.01, 0.05)}
        case "amplifier_lag":
            return {"f_Hz": u(150.0, 400.0)}
        case "sensor_lag":
            return {"f_Hz": u(150.0, 450.0)}
        case "delay":
            return {"tau_s": u(0.8e-3, 2e-3)}
        case "slew_limit":
            return {"rate_V_per_s": u(250.0, 450.0)}
        case "saturation":
            return {"top_V": u(6.8, 7.6)}
        case "rate_dependence":
            return {"per_decade": u(0.02, 0.06)}
        case "asymmetry":
            return {"share": sign * u(0.005, 0.03)}
        case "sensor_nonlinearity":
            return {"share": sign * u(0.0005, 0.001)}
        case "cross_talk":
            return {"share": u(0.002, 0.012)}
        case "mains_hum":
            return {"f_Hz": float(rng.choice([50.0, 60.0])), "amplitude_um": u(0.004, 0.01)}
        case "quantisation":
            return {"step_um": u(0.02, 0.06)}
        case "stick_slip":
            return {"width_um": u(0.03, 0.09)}
        case "timing":
            return {"ppm": sign * u(40.0, 100.0)} if rng.random() < 0.5 else {"dropped": float(rng.integers(3, 9))}
    raise ValueError(name)


NAMES = (
    "creep",
    "thermal_drift",
    "gain_drift",
    "resonance",
    "amplifier_lag",
    "sensor_lag",
    "delay",
    "slew_limit",
    "saturation",
    "rate_dependence",
    "asymmetry",
    "sensor_nonlinearity",
    "cross_talk",
    "mains_hum",
    "quantisation",
    "stick_slip",
    "timing",
)


def single(seed: int) -> Truth:
    """One effect; the names take turns."""
    rng = np.random.default_rng([seed, 1])
    name = NAMES[seed % len(NAMES)]
    return Truth(seed, effects={name: _draw(name, rng)})


def pair(seed: int) -> Truth:
    """Two effects of different sets."""
    rng = np.random.default_rng([seed, 2])
    while True:
        one, two = rng.choice(len(NAMES), 2, replace=False)
        names = {NAMES[one], NAMES[two]}
        if not any(names <= group for group in INSEPARABLE):
            return Truth(seed, effects={name: _draw(name, rng) for name in sorted(names)})


def healthy(seed: int) -> Truth:
    """Nothing but the stage, its parameters and the noise."""
    return Truth(seed, noise_um=float(np.random.default_rng([seed, 3]).uniform(0.003, 0.012)))


def other_class(seed: int) -> Truth:
    """A many-play hysteresis under the nominal Bouc-Wen stage, and one effect."""
    truth = single(seed)
    truth.hysteresis = "plays"
    return truth


#: Effects whose number scales what they do, so that they can be made as small as one likes.
SCALABLE = (
    "creep",
    "thermal_drift",
    "gain_drift",
    "rate_dependence",
    "asymmetry",
    "sensor_nonlinearity",
    "cross_talk",
    "mains_hum",
    "stick_slip",
)


def small(seed: int) -> Truth:
    """One effect that moves the readings by half the noise (rms)."""
    name = SCALABLE[seed % len(SCALABLE)]
    truth = Truth(seed, effects={name: _draw(name, np.random.default_rng([seed, 4]))})
    drive = excitation(np.random.default_rng(seed))
    rms = float(np.std(record(truth, *drive)["y_um"] - record(Truth(seed), *drive)["y_um"]))
    share = 0.5 * truth.noise_um / rms
    own = {key: value * (share if key not in ("f_Hz", "tau_s") else 1.0) for key, value in truth.effects[name].items()}
    return Truth(seed, effects={name: own})


def same(name: str, found: set[str]) -> bool:
    """Whether ``name`` is among ``found`` or in one inseparable set with something found."""
    return name in found or any(name in group and group & found for group in INSEPARABLE)
