"""Scenarios: ten kinds of disturbance that a learning model must survive, each drawn from a seed.

A scenario is data: one seed gives one stage, one disturbance and one reference. All begin with 15 s on the stage as
identified, in which the learner settles. Sizes are at the upper end of the ranges that the effects state for a stage
of this class.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray
from dehyst.sim.signals.references import DemoReference, Motion, Reference, Sequenced, Shifted, Tones, in_band, strokes
from dehyst.sim.signals.voltages import sample_times
from dehyst.sim.stage.config import ParameterChange, StageConfig
from dehyst.sim.stage.presets import preset


@dataclass(frozen=True, slots=True)
class SensorGlitches:
    """Wrong readings: ``runs`` are (first sample, number of samples, error in µm); NaN is a missing reading.

    Raises InputError on a run that is empty or begins before the first sample.
    """

    runs: tuple[tuple[int, int, float], ...] = ()

    def __post_init__(self) -> None:
        for first, count, _ in self.runs:
            if first < 0 or count < 1:
                raise InputError(f"runs: got {count} samples from {first} on, expected at least one, from 0 on")

    def applied(self, start: int, y_um: FloatArray) -> FloatArray:
        """A copy of the readings ``y_um`` (n,) µm of the samples from ``start`` on, with the errors added."""
        wrong = y_um.copy()
        stop = start + y_um.shape[0]
        for first, count, added in self.runs:
            a, b = max(first, start), min(first + count, stop)
            if a < b:
                wrong[a - start : b - start] += added
        return wrong


def glitch_burst(
    start: int, stop: int, rate: float, longest: int, size_um: tuple[float, float], rng: np.random.Generator
) -> SensorGlitches:
    """Random glitches between two samples: each sample begins one with probability ``rate``; they never overlap.

    Lengths are uniform from 1 to ``longest`` samples; sizes, of either sign, are uniform in log between the two of
    ``size_um``; one in ten is a missing reading.
    """
    runs: list[tuple[int, int, float]] = []
    at = start
    while True:
        at += int(rng.geometric(rate))
        count = int(rng.integers(1, longest + 1))
        if at + count > stop:
            return SensorGlitches(tuple(runs))
        size = math.exp(rng.uniform(*np.log(size_um))) * (1.0 if rng.random() < 0.5 else -1.0)
        runs.append((at, count, math.nan if rng.random() < 0.1 else size))
        at += count


@dataclass(frozen=True)
class Scenario:
    """A stage, the disturbance that it suffers, and the reference. Times in s after the start, displacements in µm.

    Attributes
    ----------
    kind, seed : kind of disturbance, and the seed that its size was drawn from.
    text : the disturbance in words.
    stage : the stage before the disturbance, as identified.
    motion : the reference.
    duration_s, change_s : duration of the run, and start of the disturbance.
    low_um, high_um : range of the reference.
    changes : parameter changes of the stage by time.
    glitches : wrong readings that the learner gets; errors are counted from the true ones.
    quiet_s : (start, stop) of a long rest, None where there is none.
    """

    kind: str
    seed: int
    text: str
    stage: StageConfig
    motion: Motion
    duration_s: float
    change_s: float
    low_um: float
    high_um: float
    changes: tuple[ParameterChange, ...] = ()
    glitches: SensorGlitches = field(default_factory=SensorGlitches)
    quiet_s: tuple[float, float] | None = None

    @property
    def name(self) -> str:
        """Kind and seed."""
        return f"{self.kind}/{self.seed}"

    @property
    def range_um(self) -> float:
        """Commanded range, which percentages refer to, µm."""
        return self.high_um - self.low_um

    def changing_stage(self) -> StageConfig:
        """The stage with its parameter changes."""
        return replace(self.stage, changes=self.changes)

    def reference(self) -> Reference:
        """The reference at every sample of the run."""
        return self.motion.at(sample_times(self.duration_s, self.stage.dt_s))


LOW_UM, HIGH_UM = 4.0, 80.0
CHANGE_S, RUN_S = 15.0, 40.0
#: Length of the rest between strokes in a ``dwell``, s.
DWELL_S = 600.0
#: A growing parameter is changed in steps of this length, s.
GROWTH_STEP_S = 0.02


def _base(kind: str, seed: int, text: str, stage: StageConfig, changes: tuple[ParameterChange, ...] = ()) -> Scenario:
    """A scenario on the demo's reference."""
    motion = DemoReference(RUN_S, LOW_UM, HIGH_UM, 100 + seed)
    return Scenario(kind, seed, text, stage, motion, RUN_S, CHANGE_S, LOW_UM, HIGH_UM, changes)


def _sign(rng: np.random.Generator) -> float:
    return 1.0 if rng.random() < 0.5 else -1.0


def gain_step(seed: int, rng: np.random.Generator) -> Scenario:
    """The gain jumps by 3 to 8 %, either way."""
    gain = _sign(rng) * rng.uniform(0.03, 0.08)
    changes: tuple[ParameterChange, ...] = ((CHANGE_S, {"gain_drift.gain": gain}),)
    return _base("gain_step", seed, f"gain {100 * gain:+.1f} %", preset("rich", seed=seed), changes)


def gain_ramp(seed: int, rng: np.random.Generator) -> Scenario:
    """The gain ramps by 2 to 4 % in 15 s, then stays."""
    rate_per_min = _sign(rng) * rng.uniform(0.08, 0.16)
    end_s = CHANGE_S + 15.0
    total = rate_per_min * 15.0 / 60.0
    # The ramp of the effect counts from the start of the run; the constant removes its part before the change.
    ramping = {"gain_drift.ramp_per_min": rate_per_min, "gain_drift.gain": -rate_per_min * CHANGE_S / 60.0}
    changes: tuple[ParameterChange, ...] = (
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
    changes: tuple[ParameterChange, ...] = tuple(
        (CHANGE_S + i * GROWTH_STEP_S, {"creep.gain_per_decade": before + (after - before) * (i + 1) / steps})
        for i in range(steps)
    )
    how = "appears: 0" if seed % 2 else "grows: 1.5"
    return _base("creep", seed, f"creep {how} to {100 * after:.1f} % a decade in 5 s", stage, changes)


def payload(seed: int, rng: np.random.Generator) -> Scenario:
    """A payload of 0.5 to 2 times the moved mass: the mode at 450 Hz goes down to 370 or 260 Hz."""
    ratio = rng.uniform(0.5, 2.0)
    changes: tuple[ParameterChange, ...] = ((CHANGE_S, {"resonance.payload_ratio": ratio}),)
    return _base("payload", seed, f"payload {ratio:.2f} x the moved mass", preset("rich", seed=seed), changes)


def offset_jump(seed: int, rng: np.random.Generator) -> Scenario:
    """The sensor's zero jumps by 0.5 to 3 µm."""
    offset = _sign(rng) * rng.uniform(0.5, 3.0)
    changes: tuple[ParameterChange, ...] = ((CHANGE_S, {"thermal_drift.offset_um": offset}),)
    return _base("offset_jump", seed, f"zero jumps by {offset:+.2f} µm", preset("rich", seed=seed), changes)


def glitches(seed: int, rng: np.random.Generator) -> Scenario:
    """Three seconds of wrong readings: for odd seeds single ones, for even seeds runs of up to 12 samples."""
    longest = 2 if seed % 2 else 12
    dt = preset("rich").dt_s
    bad = glitch_burst(round(CHANGE_S / dt), round((CHANGE_S + 3.0) / dt), 0.02, longest, (0.5, 40.0), rng)
    text = f"{len(bad.runs)} glitches of 1 to {longest} readings, 0.5 to 40 µm, in 3 s"
    return replace(_base("glitches", seed, text, preset("rich", seed=seed)), glitches=bad)


def dwell(seed: int, rng: np.random.Generator, rest_s: float = DWELL_S) -> Scenario:
    """Full strokes, ten minutes (or ``rest_s``) at rest, and the same full strokes again."""
    before_s, after_s = 10.0, 15.0
    hertz = float(rng.uniform(0.5, 1.0))
    level = float(rng.uniform(LOW_UM + 10.0, HIGH_UM - 10.0))
    rest = (CHANGE_S + before_s, CHANGE_S + before_s + rest_s)
    motion = Sequenced(
        (
            (CHANGE_S, DemoReference(CHANGE_S, LOW_UM, HIGH_UM, 100 + seed)),
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
    """The reference changes from 0.3-2 Hz to 8-40 Hz, and back."""
    fast_s = 12.0
    slow = in_band(LOW_UM, HIGH_UM, (0.3, 2.0), (seed, 1), 600.0)
    fast = in_band(LOW_UM, HIGH_UM, (8.0, 40.0), (seed, 2), float(rng.uniform(800.0, 1500.0)))
    hold = Tones(LOW_UM)
    back = Shifted(DemoReference(RUN_S, LOW_UM, HIGH_UM, 100 + seed), CHANGE_S + fast_s)
    motion = Sequenced(((1.0, hold), (CHANGE_S, slow), (CHANGE_S + fast_s, fast), (RUN_S, back)))
    text = "reference from 0.3-2 Hz to 8-40 Hz, and back after 12 s"
    return replace(_base("band", seed, text, preset("rich", seed=seed)), motion=motion)


def amplifier_lag(seed: int, rng: np.random.Generator) -> Scenario:
    """The lag of the amplifier grows from 0.064 ms to 0.5-1.5 ms."""
    tau_s = rng.uniform(0.5e-3, 1.5e-3)
    changes: tuple[ParameterChange, ...] = ((CHANGE_S, {"amplifier_lag.tau_s": tau_s}),)
    return _base("amplifier_lag", seed, f"amplifier lag {1e3 * tau_s:.2f} ms", preset("rich", seed=seed), changes)


def noise(seed: int, rng: np.random.Generator) -> Scenario:
    """The sensor's noise triples."""
    stage = preset("rich", seed=seed)
    rms = stage.effects["sensor_noise"].values["rms_um"]
    changes: tuple[ParameterChange, ...] = ((CHANGE_S, {"sensor_noise.rms_um": 3.0 * rms}),)
    return _base("noise", seed, "sensor noise x 3", stage, changes)


#: Every kind of scenario by name, in the order of the table.
SCENARIO_KINDS: Final[dict[str, Callable[[int, np.random.Generator], Scenario]]] = {
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
    """The scenario of a kind and a seed from 1 on; ``rest_s`` is the length of the rest in a ``dwell``, s.

    Raises InputError on an unknown kind, a bad seed, or a rest out of range.
    """
    if kind not in SCENARIO_KINDS:
        raise InputError(f"kind: got {kind!r}, expected one of: {', '.join(SCENARIO_KINDS)}")
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 1:
        raise InputError(f"seed: got {seed!r}, expected an integer from 1 on")
    if not 0.0 < rest_s <= 86_400.0:
        raise InputError(f"rest_s: got {rest_s!r}, expected a time above 0 s, up to a day")
    rng = np.random.default_rng((seed, list(SCENARIO_KINDS).index(kind)))
    return dwell(seed, rng, rest_s) if kind == "dwell" else SCENARIO_KINDS[kind](seed, rng)
