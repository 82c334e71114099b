"""The ten kinds of drift that adapting has to survive, each drawn from a seed.

All begin with 15 s on a stage that is as it was identified, so that the learner has settled. Magnitudes are those that
the effects state for a stage of this class, at their upper end.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np

from adaptive.errors import InputError
from sim.scenarios.motion import Parts, Shifted, Tones, demo_motion, in_band, strokes
from sim.scenarios.readings import glitch_burst
from sim.scenarios.scenario import Scenario
from sim.stage.config import Change, StageConfig
from sim.stage.presets import preset

LOW_UM, HIGH_UM = 4.0, 80.0
CHANGE_S, RUN_S = 15.0, 40.0
#: Length of the rest between strokes, s: ten minutes.
DWELL_S = 600.0
#: Steps in which a parameter that grows is changed, s.
GROWTH_STEP_S = 0.02


def _base(kind: str, seed: int, text: str, stage: StageConfig, changes: tuple[Change, ...] = ()) -> Scenario:
    """A scenario on the demo's reference."""
    motion = demo_motion(RUN_S, LOW_UM, HIGH_UM, 100 + seed)
    return Scenario(kind, seed, text, stage, motion, RUN_S, CHANGE_S, LOW_UM, HIGH_UM, changes)


def _sign(rng: np.random.Generator) -> float:
    return 1.0 if rng.random() < 0.5 else -1.0


def gain_step(seed: int, rng: np.random.Generator) -> Scenario:
    """The gain jumps by 3 to 8 %, either way."""
    gain = _sign(rng) * rng.uniform(0.03, 0.08)
    changes: tuple[Change, ...] = ((CHANGE_S, {"gain_drift.gain": gain}),)
    return _base("gain_step", seed, f"gain {100 * gain:+.1f} %", preset("rich", seed=seed), changes)


def gain_ramp(seed: int, rng: np.random.Generator) -> Scenario:
    """The gain ramps by 2 to 4 % in 15 s, then stays."""
    rate_per_min = _sign(rng) * rng.uniform(0.08, 0.16)
    end_s = CHANGE_S + 15.0
    total = rate_per_min * 15.0 / 60.0
    # The effect's ramp counts from the start of the run; its constant takes away what had been before.
    ramping = {"gain_drift.ramp_per_min": rate_per_min, "gain_drift.gain": -rate_per_min * CHANGE_S / 60.0}
    changes: tuple[Change, ...] = (
        (CHANGE_S, ramping),
        (end_s, {"gain_drift.ramp_per_min": 0.0, "gain_drift.gain": total}),
    )
    return _base("gain_ramp", seed, f"gain {100 * total:+.1f} % in 15 s", preset("rich", seed=seed), changes)


def creep(seed: int, rng: np.random.Generator) -> Scenario:
    """Creep grows to 3 to 4 % a decade in 5 s; for odd seeds from none, for even ones from the stage's own 1.5 %."""
    stage = preset("rich", seed=seed)
    before = 0.0 if seed % 2 else 0.015
    stage = replace(stage, effects=stage.effects.replace({"creep.gain_per_decade": before}))
    after = rng.uniform(0.03, 0.04)
    steps = round(5.0 / GROWTH_STEP_S)
    changes: tuple[Change, ...] = tuple(
        (CHANGE_S + i * GROWTH_STEP_S, {"creep.gain_per_decade": before + (after - before) * (i + 1) / steps})
        for i in range(steps)
    )
    how = "appears: 0" if seed % 2 else "grows: 1.5"
    return _base("creep", seed, f"creep {how} to {100 * after:.1f} % a decade in 5 s", stage, changes)


def payload(seed: int, rng: np.random.Generator) -> Scenario:
    """A payload of 0.5 to 2 times the moved mass: the mode at 450 Hz goes down to 370 or 260 Hz."""
    ratio = rng.uniform(0.5, 2.0)
    changes: tuple[Change, ...] = ((CHANGE_S, {"resonance.payload_ratio": ratio}),)
    return _base("payload", seed, f"payload {ratio:.2f} x the moved mass", preset("rich", seed=seed), changes)


def offset_jump(seed: int, rng: np.random.Generator) -> Scenario:
    """The sensor's zero jumps by 0.5 to 3 µm."""
    offset = _sign(rng) * rng.uniform(0.5, 3.0)
    changes: tuple[Change, ...] = ((CHANGE_S, {"thermal_drift.offset_um": offset}),)
    return _base("offset_jump", seed, f"zero jumps by {offset:+.2f} µm", preset("rich", seed=seed), changes)


def glitches(seed: int, rng: np.random.Generator) -> Scenario:
    """Three seconds of wrong readings: for odd seeds single ones, for even seeds runs of up to 12 samples."""
    longest = 2 if seed % 2 else 12
    dt = preset("rich").dt_s
    bad = glitch_burst(round(CHANGE_S / dt), round((CHANGE_S + 3.0) / dt), 0.02, longest, (0.5, 40.0), rng)
    text = f"{len(bad.runs)} glitches of 1 to {longest} readings, 0.5 to 40 µm, in 3 s"
    return replace(_base("glitches", seed, text, preset("rich", seed=seed)), readings=bad)


def dwell(seed: int, rng: np.random.Generator, rest_s: float = DWELL_S) -> Scenario:
    """Full strokes, ten minutes (or ``rest_s``) at rest, and the same full strokes again."""
    before_s, after_s = 10.0, 15.0
    hertz = float(rng.uniform(0.5, 1.0))
    level = float(rng.uniform(LOW_UM + 10.0, HIGH_UM - 10.0))
    rest = (CHANGE_S + before_s, CHANGE_S + before_s + rest_s)
    motion = Parts(
        (
            (CHANGE_S, demo_motion(CHANGE_S, LOW_UM, HIGH_UM, 100 + seed)),
            (rest[0], strokes(LOW_UM, HIGH_UM, hertz, CHANGE_S)),
            (rest[1], Tones(level)),
            (rest[1] + after_s, strokes(LOW_UM, HIGH_UM, hertz, rest[1])),
        )
    )
    stage = preset("rich", seed=seed)
    text = f"{rest_s:g} s at rest at {level:.0f} µm, then full strokes at {hertz:.2f} Hz"
    end_s = rest[1] + after_s
    return Scenario("dwell", seed, text, stage, motion, end_s, rest[1], LOW_UM, HIGH_UM, quiet_s=rest)


def band(seed: int, rng: np.random.Generator) -> Scenario:
    """The reference leaves 0.3 to 2 Hz for 8 to 40 Hz, and comes back."""
    fast_s = 12.0
    slow = in_band(LOW_UM, HIGH_UM, (0.3, 2.0), (seed, 1), 600.0)
    fast = in_band(LOW_UM, HIGH_UM, (8.0, 40.0), (seed, 2), float(rng.uniform(800.0, 1500.0)))
    hold = Tones(LOW_UM)
    back = Shifted(demo_motion(RUN_S, LOW_UM, HIGH_UM, 100 + seed), CHANGE_S + fast_s)
    motion = Parts(((1.0, hold), (CHANGE_S, slow), (CHANGE_S + fast_s, fast), (RUN_S, back)))
    text = "reference from 0.3-2 Hz to 8-40 Hz, and back after 12 s"
    return replace(_base("band", seed, text, preset("rich", seed=seed)), motion=motion)


def amplifier_lag(seed: int, rng: np.random.Generator) -> Scenario:
    """The amplifier becomes slow: a lag of 0.5 to 1.5 ms where there were 0.064 ms."""
    tau_s = rng.uniform(0.5e-3, 1.5e-3)
    changes: tuple[Change, ...] = ((CHANGE_S, {"amplifier_lag.tau_s": tau_s}),)
    return _base("amplifier_lag", seed, f"amplifier lag {1e3 * tau_s:.2f} ms", preset("rich", seed=seed), changes)


def noise(seed: int, rng: np.random.Generator) -> Scenario:
    """The sensor's noise triples."""
    stage = preset("rich", seed=seed)
    rms = stage.effects["sensor_noise"].values["rms_um"]
    changes: tuple[Change, ...] = ((CHANGE_S, {"sensor_noise.rms_um": 3.0 * rms}),)
    return _base("noise", seed, "sensor noise x 3", stage, changes)


#: Every kind by name, in the order of the table.
KINDS: Final[dict[str, Callable[[int, np.random.Generator], Scenario]]] = {
    "gain_step": gain_step,
    "gain_ramp": gain_ramp,
    "creep": creep,
    "payload": payload,
    "offset_jump": offset_jump,
    "glitches": glitches,
    "dwell": dwell,
    "band": band,
    "amplifier_lag": amplifier_lag,
    "noise": noise,
}


def scenario(kind: str, seed: int, rest_s: float = DWELL_S) -> Scenario:
    """The scenario of a kind and a seed, 1 or more; ``rest_s`` is the length of the rest of a ``dwell``, s.

    Raises InputError on an unknown kind or seed, and on a rest of no length.
    """
    if kind not in KINDS:
        raise InputError(f"kind: got {kind!r}, expected one of: {', '.join(KINDS)}")
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 1:
        raise InputError(f"seed: got {seed!r}, expected an integer from 1 on")
    if not 0.0 < rest_s <= 86_400.0:
        raise InputError(f"rest_s: got {rest_s!r}, expected a time above 0 s, up to a day")
    rng = np.random.default_rng((seed, list(KINDS).index(kind)))
    return dwell(seed, rng, rest_s) if kind == "dwell" else KINDS[kind](seed, rng)
