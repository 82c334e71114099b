"""Cases by seed: rigs, drives, noise, effects and their sizes. The same seed gives the same case on every machine.

An effect is drawn again (with its rig and drive) until it can be seen: it changes the reading by at least `LEAST_RMS`
times the noise in rms, and by `LEAST_OWN` times after offset, gain, loop width and lag are fitted anew.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tests.hidden.cases import INSEPARABLE
from tests.hidden.foreign.bases import BASES, OTHER_CLASS, Array
from tests.hidden.foreign.drives import EXCITATION_HZ, EXCITATION_S, SHOWS
from tests.hidden.foreign.noise import KINDS as NOISES
from tests.hidden.foreign.record import Case, Rig, record

#: The catalogue, in the order in which `single` takes its turns.
CAUSES = (
    "creep",
    "resonance",
    "cross_talk",
    "saturation",
    "thermal_drift",
    "amplifier_lag",
    "quantisation",
    "rate_dependence",
    "gain_drift",
    "delay",
    "mains_hum",
    "asymmetry",
    "timing",
    "sensor_lag",
    "hysteresis_shape",
    "slew_limit",
    "stick_slip",
    "payload_change",
    "sensor_nonlinearity",
)
#: Not drawn together: one voltage and one sensor show only their sum, or they share the one mode.
EXCLUSIVE = (*INSEPARABLE, {"asymmetry", "sensor_nonlinearity"}, {"resonance", "payload_change"})
LEAST_RMS = 5.0
LEAST_OWN = 3.0
#: Range of the noise, share of the stroke. Where an effect is small it is less, down to the last.
NOISE_FROM, NOISE_TO, NOISE_LEAST = 2e-5, 1e-4, 3e-6
#: Share of the records (healthy ones excepted) that begin with the memory of earlier cycles.
USED_BEFORE = 0.25
#: Most samples of a recording that the diagnosis uses.
MOST_SAMPLES = 200_000


def draw_rig(seed: int, rng: np.random.Generator, kinds: list[str], base: str, noise_kind: str) -> Rig:
    """A random rig with one of the drives ``kinds``."""
    u = rng.uniform
    kind = str(rng.choice(kinds))
    fs = float(rng.choice([500.0, 1000.0, 2000.0, 4000.0, 10_000.0], p=[0.15, 0.25, 0.35, 0.15, 0.1]))
    duration = float(u(20.0, 70.0))
    if kind == "excitation":
        fs = float(rng.choice([EXCITATION_HZ, 1.5 * EXCITATION_HZ]))
        duration = EXCITATION_S * EXCITATION_HZ / fs
    duration = min(duration, MOST_SAMPLES / fs)
    chapter = rng.random() < 0.3
    stroke = float(u(80.0, 95.0) if chapter else np.exp(u(np.log(10.0), np.log(120.0))))
    return Rig(
        seed=seed,
        base=base,
        used_before=bool(rng.random() < USED_BEFORE),
        drive=kind,
        noise=noise_kind,
        fs_hz=fs,
        duration_s=duration,
        span_V=8.0 if chapter else float(rng.choice([5.0, 10.0, 75.0, 100.0, 150.0])),
        stroke_um=stroke,
        lag_s=float(u(0.4e-3, 3e-3)),
        straight=bool(rng.random() < 0.3),
        early=float(rng.choice([0.0, 0.5])),
        sigma_um=stroke * float(np.exp(u(np.log(NOISE_FROM), np.log(NOISE_TO)))),
        offset_um=stroke * float(u(-0.02, 0.1)),
    )


def _lag(rig: Rig, rng: np.random.Generator) -> dict[str, float]:
    return {"tau_s": float(max(0.5 / rig.fs_hz, np.exp(rng.uniform(np.log(4e-4), np.log(6e-3)))))}


def _mode(rig: Rig, rng: np.random.Generator) -> tuple[float, float]:
    low, high = max(60.0, 0.03 * rig.fs_hz), min(1200.0, 0.2 * rig.fs_hz)
    return float(np.exp(rng.uniform(np.log(low), np.log(high)))), float(
        np.exp(rng.uniform(np.log(0.008), np.log(0.05)))
    )


def _timing(rng: np.random.Generator) -> dict[str, float]:
    which = rng.integers(3)
    if which == 0:
        return {"ppm": float(rng.choice([-1.0, 1.0]) * rng.uniform(40.0, 200.0))}
    if which == 1:
        return {"slips": float(rng.integers(3, 9)), "sign": float(rng.choice([-1.0, 1.0]))}
    return {"rows": float(rng.integers(3, 20))}


def _payload(rig: Rig, rng: np.random.Generator) -> dict[str, float]:
    f, z = _mode(rig, rng)
    ratio = float(rng.choice([rng.uniform(0.1, 0.8), rng.uniform(-0.35, -0.1)]))
    # Half of the records begin with the payload on, in the others it changes midway.
    return {
        "known_Hz": f,
        "damping": z,
        "ratio": ratio,
        "from_share": float(rng.choice([0.0, rng.uniform(0.35, 0.65)])),
    }


def draw_effect(name: str, rig: Rig, rng: np.random.Generator) -> dict[str, float]:
    """Random numbers of one effect on this rig; sizes as a share of the range unless their names say otherwise."""
    u = rng.uniform
    sign = float(rng.choice([-1.0, 1.0]))
    match name:
        case "creep":
            power = float(u(0.08, 0.2))
            # The decade from 1 s to 10 s grows by 0.5 to 2 % of the step.
            return {"share": float(u(0.005, 0.02) / (201.0**power - 21.0**power)), "power": power}
        case "thermal_drift":
            return {"total_um": sign * float(u(0.003, 0.015)) * rig.stroke_um, "tau_s": float(u(1.0, 15.0))}
        case "gain_drift":
            return {"total": sign * float(u(0.004, 0.02))}
        case "resonance":
            f, z = _mode(rig, rng)
            if rng.random() < 0.3:
                return {
                    "f_Hz": f,
                    "damping": z,
                    "second_Hz": f * float(u(1.3, 1.9)),
                    "second_share": float(u(0.03, 0.1)),
                }
            return {"f_Hz": f, "damping": z}
        case "payload_change":
            return _payload(rig, rng)
        case "amplifier_lag" | "sensor_lag":
            return _lag(rig, rng)
        case "slew_limit":
            return {"rate_V_per_s": float(np.exp(u(np.log(12.0), np.log(150.0)))) * rig.span_V}
        case "saturation":
            return {"top_V": float(u(0.8, 0.95)) * rig.span_V}
        case "delay":
            return {"tau_s": float(max(u(1.3, 4.5) / rig.fs_hz, u(5e-4, 2e-3)))}
        case "sensor_nonlinearity":
            return {"share": sign * float(u(0.0006, 0.002))}
        case "cross_talk":
            return {"share": sign * float(u(0.002, 0.015)), "rate_s": float(u(-5e-5, 5e-5))}
        case "mains_hum":
            f = float(rng.choice([50.0, 60.0]) + u(-0.1, 0.1))
            return {"f_Hz": f, "amplitude_um": float(u(5e-5, 4e-4)) * rig.stroke_um}
        case "quantisation":
            return {"step_um": float(u(3e-4, 1e-3)) * rig.stroke_um}
        case "stick_slip":
            return {"reach_um": float(u(4e-4, 1.5e-3)) * rig.stroke_um}
        case "timing":
            return _timing(rng)
        case "rate_dependence":
            return {"per_decade": float(u(0.03, 0.09)), "corner_per_s": float(np.exp(u(np.log(0.2), np.log(2.0))))}
        case "asymmetry":
            if rng.random() < 0.5:
                return {"share": sign * float(u(0.006, 0.025))}
            return {"knee": float(u(0.3, 0.6)), "slope": sign * float(u(0.02, 0.07))}
        case "hysteresis_shape":
            return {}
    raise ValueError(f"effect: got {name!r}, expected one of {', '.join(CAUSES)}")


def change(case: Case, name: str, whole: dict[str, Array]) -> tuple[float, float] | None:
    """Change of the reading by one effect in rms, µm: as it is, and after a new fit of what a nominal stage has.

    ``whole``: `record` of the case without noise. None where there is no reading to compare with (lost rows).
    """
    if name == "hysteresis_shape" or "rows" in case.effects[name]:
        return None
    difference = whole["y_um"] - record(case.without(name).quiet())["y_um"]
    y = whole["y_um"]
    columns = np.column_stack([np.ones(y.size), whole["u_V"], y, np.gradient(y)])
    columns /= np.linalg.norm(columns, axis=0)
    left = difference - columns @ np.linalg.lstsq(columns, difference, rcond=1e-10)[0]
    return float(np.sqrt(np.mean(difference**2))), float(np.sqrt(np.mean(left**2)))


def _seen(case: Case) -> Case | None:
    """The case with its sizes, and with noise small enough that all its effects are seen; None if they cannot be."""
    rig = case.rig
    if any("rows" in numbers for numbers in case.effects.values()) and len(case.effects) > 1:
        # Records of unequal length cannot be compared: measure the other effects without the lost rows.
        others = _seen(case.without("timing"))
        return None if others is None else replace(case, rig=others.rig, sizes=others.sizes)
    whole = record(case.quiet())
    sigma, sizes = rig.sigma_um, {}
    for name in case.effects:
        found = change(case, name, whole)
        if found is None:
            continue
        rms, own = found
        sizes[name] = rms / rig.stroke_um
        sigma = min(sigma, rms / (1.2 * LEAST_RMS), own / LEAST_OWN)
    if sigma < NOISE_LEAST * rig.stroke_um:
        return None
    return replace(case, rig=replace(rig, sigma_um=sigma), sizes=sizes)


def draw_case(kind: str, seed: int, names: list[str], rng: np.random.Generator) -> Case:
    """A case with these effects hidden, drawn until all of them can be seen."""
    drives = [drive for drive, shown in SHOWS.items() if shown >= set(names)]
    noise_kind = str(rng.choice(NOISES, p=[0.6, 0.2, 0.2]))
    for attempt in range(40):
        base = str(rng.choice(OTHER_CLASS if "hysteresis_shape" in names else list(BASES)))
        rig = draw_rig(1000 * seed + attempt, rng, drives, base, noise_kind)
        if rig.fs_hz < 2.0 * 180.0 and "mains_hum" in names:
            continue
        if "payload_change" in names:
            # The stage file that states the mode has no other mechanics.
            rig = replace(rig, lag_s=0.0)
        case = _seen(Case(kind, seed, rig, {name: draw_effect(name, rig, rng) for name in names}))
        if case is not None:
            return case
    raise RuntimeError(f"{kind} {seed}: {', '.join(names)} could not be made visible in 40 rigs; widen their sizes")


def single(seed: int) -> Case:
    """One cause; the causes take turns."""
    return draw_case("single", seed, [CAUSES[seed % len(CAUSES)]], np.random.default_rng([seed, 21]))


def _several(kind: str, count: int, seed: int, purpose: int) -> Case:
    rng = np.random.default_rng([seed, purpose])
    # A foreign base is a cause of its own already.
    pool = [name for name in CAUSES if name != "hysteresis_shape"]
    while True:
        names = sorted(str(name) for name in rng.choice(pool, count, replace=False))
        apart = not any(len(group & set(names)) > 1 for group in EXCLUSIVE)
        if apart and any(shown >= set(names) for shown in SHOWS.values()):
            return draw_case(kind, seed, names, rng)


def pair(seed: int) -> Case:
    """Two causes that can be told apart."""
    return _several("pair", 2, seed, 22)


def triple(seed: int) -> Case:
    """Three causes that can be told apart."""
    return _several("triple", 3, seed, 23)


def healthy(seed: int) -> Case:
    """No cause, in noise of every kind in turn; every second round on a base of another class."""
    rng = np.random.default_rng([seed, 24])
    turn = seed // len(NOISES)
    base = "bouc_wen" if turn % 2 == 0 else str(rng.choice(OTHER_CLASS))
    rig = draw_rig(1000 * seed, rng, list(SHOWS), base, NOISES[seed % len(NOISES)])
    return Case("healthy", seed, replace(rig, used_before=False))
