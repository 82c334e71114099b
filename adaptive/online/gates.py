"""Gates: which samples may be learnt. Each gate has a name under which its samples are counted.

The first gates check the raw sample: finite, in sequence, plausible time step, not a glitch of the sensor. A sample
that passes them advances the smoother. The later gates check the resulting pair of smoothed motion and voltage:
settled, not saturated, in range, moving. Refused samples change no model.

The envelope bounds what is learnt. A model outside of it is not served: the last good model or the identified one stays
in service.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import isfinite, sqrt
from typing import Annotated

import numpy as np

from dehyst.adaptive.compiled import shared
from dehyst.adaptive.errors import InputError
from dehyst.adaptive.features import FeatureMap
from dehyst.adaptive.state import Entry, Numbers
from dehyst.adaptive.types import Sample

# --- Gates.

#: Limit of plausible readings and voltages, µm or V.
ABSURD = 1e9
#: Share of the voltage between the rails by which a voltage may be beyond them.
RAIL_SLACK = 0.02
#: Decay of a kink of the voltage per sample, and allowed prediction error as a multiple of the motion it causes.
KINK_DECAY, KINK_SHARE = 0.9, 2.0
#: Samples over which the smoother's prediction errors are averaged; each counts at most this many times the rms.
INNOVATION_SAMPLES, FAR_RMS = 500, 2.0
#: Equal readings are none where so many come while the voltage moves by this share of its span, and by this many times
#: the usual prediction error of the smoother: share, multiple, number of readings.
STUCK_SHARE, STUCK_SIGMA, REPEATED = 0.002, 8.0, 4
#: Sample time up to which ``glitch_share`` is not scaled, s.
GLITCH_DT_S = 1e-3

LEARNT = "learnt"
#: Passed all gates, but neither filter nor window was due (``filter_every``, ``learn_every``).
PASSED = "passed"
NOT_FINITE = "not_finite"
DUPLICATE = "duplicate"
OUT_OF_ORDER = "out_of_order"
TIMING = "timing"
GAP = "gap"
GLITCH = "glitch"
#: Held back: the stage rings after a shock or a jump.
RINGING = "ringing"
#: The sensor is on trial: it must follow the drive again first.
UNTRUSTED = "untrusted"
SETTLING = "settling"
SATURATED = "saturated"
OUT_OF_RANGE = "out_of_range"
UNEXCITED = "unexcited"
OUTLIER = "outlier"
REDUNDANT = "redundant"
FROZEN = "frozen"
NUMERICS = "numerics"
REASONS = (
    NOT_FINITE, DUPLICATE, OUT_OF_ORDER, TIMING, GAP, GLITCH, RINGING, UNTRUSTED, SETTLING, SATURATED, OUT_OF_RANGE,
    UNEXCITED, OUTLIER, REDUNDANT, FROZEN, NUMERICS,
)  # fmt: skip
#: Results of a sample; compiled code has their numbers.
OUTCOMES = (LEARNT, PASSED, *REASONS)


@dataclass(frozen=True, slots=True)
class AdmissionConfig:
    """Limits of the gates.

    u_min_V, u_max_V : the amplifier's rails (default: the limits of the axis).
    rail_margin_V : a voltage within this of a rail is not learnt.
    y_min_um, y_max_um : range of the sensor.
    surprise_share, surprise_sigma : a reading this far from its prediction (share of the model's range at up to 1 ms;
    times the usual error) is held until the next ones explain it.
    glitch_share : a reading this far off is always held.
    jump_share : largest jump, share of the range, believed after glitch_persistence readings.
    glitch_persistence : a jump is believed after more readings at the new level than this.
    doubt_persistence : the same where the sensor was wrong within doubt_s, and beyond glitch_share to jump_share.
    doubt_s : see doubt_persistence.
    max_gap : most missing samples that are bridged; after more, the smoother restarts.
    settle : samples after a start that are not learnt.
    timing_tolerance : relative error of the time step between two samples.
    rest_share, rest_s : a stage that has stayed within this share of the range for this long is at rest.
    """

    u_min_V: float = -ABSURD
    u_max_V: float = ABSURD
    rail_margin_V: float = 1e-3
    y_min_um: float = -ABSURD
    y_max_um: float = ABSURD
    surprise_share: float = 0.002
    surprise_sigma: float = 12.0
    glitch_share: float = 0.012
    jump_share: float = 0.12
    glitch_persistence: int = 12
    doubt_persistence: int = 16
    doubt_s: float = 10.0
    max_gap: int = 25
    settle: int = 50
    timing_tolerance: float = 0.5
    rest_share: float = 0.002
    rest_s: float = 0.2

    def __post_init__(self) -> None:
        for low, high in (("u_min_V", "u_max_V"), ("y_min_um", "y_max_um")):
            if not getattr(self, low) < getattr(self, high):
                raise InputError(
                    f"admission.{low}, {high}: got {getattr(self, low)}, {getattr(self, high)}, expected {low} < {high}"
                )
        positive = ("surprise_share", "surprise_sigma", "glitch_share", "jump_share", "rest_share", "rest_s")
        for name in (*positive, "timing_tolerance"):
            if not getattr(self, name) > 0.0:
                raise InputError(f"admission.{name}: got {getattr(self, name)}, expected a positive number")
        for name in ("glitch_persistence", "doubt_persistence", "max_gap", "settle", "doubt_s"):
            if getattr(self, name) < 0:
                raise InputError(f"admission.{name}: got {getattr(self, name)}, expected a number, not negative")

    def at(self, dt_s: float) -> AdmissionConfig:
        """The limits for a sample time, s: predictions over a longer step are worse, so the limits widen."""
        wider = max(1.0, dt_s / GLITCH_DT_S)
        return replace(self, glitch_share=self.glitch_share * wider, surprise_share=self.surprise_share * wider)


class AdmissionState(Numbers):
    """What the gates remember of the samples so far."""

    seq: Annotated[int, Entry("the last sample taken", low=-1)] = -1
    t_s: Annotated[float, Entry("its time", "s")] = 0.0
    since_start: Annotated[int, Entry("samples since the smoother started", low=0)] = 0
    since_glitch: Annotated[int, Entry("samples since the sensor was last found wrong", low=0)] = 1_000_000_000
    moved: Annotated[int, Entry("the smoother's count when the stage last left a place", low=0)] = 0
    anchor_um: Annotated[float, Entry("where the stage then was", "µm")] = 0.0
    u_V: Annotated[float, Entry("the last voltage", "V")] = 0.0
    u_before_V: Annotated[float, Entry("the voltage before", "V")] = 0.0
    kink_V: Annotated[float, Entry("largest kink of the voltage of late, fading", "V", low=0.0)] = 0.0
    innovation2: Annotated[float, Entry("mean square error of the smoother's predictions", "ranges²", low=0.0)] = 0.0

    y_um: Annotated[float, Entry("the last reading", "µm")] = 0.0
    same: Annotated[int, Entry("how many readings in a row are equal to it", low=0)] = 0
    low_V: Annotated[float, Entry("lowest voltage meanwhile", "V")] = 0.0
    high_V: Annotated[float, Entry("highest voltage meanwhile", "V")] = 0.0

    @shared
    def take(self, sample: Sample, steps: int) -> None:
        """Note a sample that has passed `check_sample`, ``steps`` sample times after the last one."""
        self.seq, self.t_s = sample.seq, sample.t_s
        self.since_glitch += steps

    def restart(self) -> None:
        """The smoother starts again."""
        self.since_start = self.moved = 0

    @shared
    def step(self) -> None:
        """The smoother makes a step."""
        self.since_start += 1

    def note_glitch(self) -> None:
        """The sensor was found to have been wrong until now."""
        self.since_glitch = 0


@shared
def check_sample(config: AdmissionConfig, state: AdmissionState, sample: Sample, dt_s: float) -> str:
    """Gate of the raw sample: "" where it may go on. Does not change the state. Never raises on data."""
    # The square of a reading must be finite too.
    if not (isfinite(sample.t_s) and abs(sample.u_V) < ABSURD and abs(sample.y_um) < ABSURD):
        return NOT_FINITE
    # No amplifier gives a voltage beyond its rails: the sample is of another stage, or in another unit.
    slack_V = RAIL_SLACK * (config.u_max_V - config.u_min_V)
    if not config.u_min_V - slack_V <= sample.u_V <= config.u_max_V + slack_V:
        return OUT_OF_RANGE
    if state.seq < 0:
        return ""
    if sample.seq == state.seq:
        return DUPLICATE
    if sample.seq < state.seq:
        return OUT_OF_ORDER
    expected_s = (sample.seq - state.seq) * dt_s
    if abs(sample.t_s - state.t_s - expected_s) > config.timing_tolerance * expected_s:
        return TIMING
    return ""


@shared
def check_pair(config: AdmissionConfig, u_V: float, u_before_V: float, y_um: float) -> str:
    """Gate of a smoothed pair: "" where it may be learnt. The voltage before it counts too, because of lags."""
    low, high = config.u_min_V + config.rail_margin_V, config.u_max_V - config.rail_margin_V
    if not (low < u_V < high and low < u_before_V < high):
        return SATURATED
    if not config.y_min_um <= y_um <= config.y_max_um:
        return OUT_OF_RANGE
    return ""


@shared
def watch_voltage(state: AdmissionState, u_V: float) -> None:
    """Note a voltage and its kink: the smoother's prediction cannot know the motion that a kink causes."""
    kink = abs(u_V - 2.0 * state.u_V + state.u_before_V)
    state.kink_V = max(kink, KINK_DECAY * state.kink_V)
    state.u_before_V, state.u_V = state.u_V, u_V


@shared
def surprise(config: AdmissionConfig, state: AdmissionState, span_V: float) -> float:
    """Distance from the smoother's prediction beyond which a reading is held back, in ranges.

    A multiple of the usual prediction error, plus the motion that a recent kink of the voltage can cause.
    """
    usual = max(config.surprise_share, config.surprise_sigma * state.innovation2**0.5)
    return float(usual + KINK_SHARE * state.kink_V / span_V)


@shared
def watch_innovation(config: AdmissionConfig, state: AdmissionState, innovation: float) -> None:
    """Update the mean square prediction error of the smoother, in ranges²; outliers are limited to ``FAR_RMS``."""
    most = max(FAR_RMS * state.innovation2**0.5, config.surprise_share / config.surprise_sigma)
    error = min(abs(innovation), most)
    state.innovation2 += (error * error - state.innovation2) / INNOVATION_SAMPLES


@shared
def check_repeats(state: AdmissionState, sample: Sample, span_V: float) -> str:
    """Gate of a reading that is the last one again while the voltage moves. Call it with every reading."""
    u_V = sample.u_V
    if sample.y_um != state.y_um:
        state.y_um, state.same, state.low_V, state.high_V = sample.y_um, 1, u_V, u_V
        return ""
    state.same += 1
    state.low_V, state.high_V = min(state.low_V, u_V), max(state.high_V, u_V)
    share = max(STUCK_SHARE, STUCK_SIGMA * state.innovation2**0.5)
    moved = state.high_V - state.low_V > share * span_V
    return GLITCH if state.same >= REPEATED and moved else ""


@shared
def settling(config: AdmissionConfig, state: AdmissionState) -> bool:
    """Whether the smoother has just started: it does not know the velocity yet."""
    return state.since_start <= config.settle


@shared
def at_rest(
    config: AdmissionConfig, state: AdmissionState, y_um: float, count: int, range_um: float, dt_s: float
) -> bool:
    """Whether the stage, now at ``y_um``, has stayed in place for ``rest_s``; ``count`` of the smoother's steps.

    Judged by position, not by speed: speed is noisy, and neither a slow scan nor a turning point is a rest.
    """
    if abs(y_um - state.anchor_um) > config.rest_share * range_um:
        state.anchor_um, state.moved = y_um, count
    return (count - state.moved) * dt_s > config.rest_s


# --- Errors of the served model: whether it is valid, and whether the identified one predicts better.
#
# The error is the measured voltage minus the voltage that the model gives for the measured motion, before the sample is
# learnt, with the model as old as an answer is when it takes effect. The identified (frozen) model is judged likewise.


#: Time constants of the mean square errors, s: long for reports and stated uncertainty, short to detect trouble.
LONG_S, SHORT_S = 2.0, 0.1

#: The frozen model is served where the learner's short-term rms exceeds its own by this factor plus a floor.
FALLBACK_RATIO = 1.3


class Judgement(Numbers):
    """Mean square prediction errors, V², over long and short time, of the learner and of the frozen model."""

    long_V2: Annotated[float, Entry("mean square error of the learner over long time", "V²", low=0.0)]
    short_V2: Annotated[float, Entry("the same over short time", "V²", low=0.0)]
    frozen_V2: Annotated[float, Entry("mean square error of the identified model over long time", "V²", low=0.0)]
    frozen_short_V2: Annotated[float, Entry("the same over short time", "V²", low=0.0)]
    error_V: Annotated[float, Entry("the learner's last error", "V")] = 0.0
    judged: Annotated[int, Entry("errors", low=0)] = 0
    inside: Annotated[int, Entry("errors within one stated standard deviation", low=0)] = 0
    valid: Annotated[bool, Entry("whether the learnt model is valid")] = True
    fallback: Annotated[bool, Entry("whether the identified model is served because it predicts better")] = False
    fallen_s: Annotated[float, Entry("for how long", "s", low=0.0)] = 0.0
    doubt_V2: Annotated[float, Entry("extra variance after a jump of open cause; it decays", "V²", low=0.0)] = 0.0

    @shared
    def take(self, error_V: float, frozen_error_V: float, step_s: float) -> None:
        """Take one error of the learnt and of the frozen model, V."""
        squared = error_V * error_V
        slow, fast = min(1.0, step_s / LONG_S), min(1.0, step_s / SHORT_S)
        if self.judged > 0 and squared <= max(self.long_V2, self.short_V2) + self.doubt_V2:
            self.inside += 1
        self.error_V = error_V
        self.judged += 1
        self.long_V2 += (squared - self.long_V2) * slow
        self.short_V2 += (squared - self.short_V2) * fast
        self.doubt_V2 *= 1.0 - fast
        frozen = frozen_error_V * frozen_error_V
        self.frozen_V2 += (frozen - self.frozen_V2) * slow
        self.frozen_short_V2 += (frozen - self.frozen_short_V2) * fast

    @shared
    def decide(self, enter_V: float, leave_V: float) -> bool:
        """Validity with hysteresis: lost when the short-term rms exceeds ``leave_V``, regained below ``enter_V``."""
        rms = sqrt(self.short_V2)
        if self.valid and rms > leave_V:
            self.valid = False
        elif not self.valid and rms < enter_V:
            self.valid = True
        return self.valid

    @shared
    def choose(self, floor_V: float, step_s: float) -> bool:
        """Whether to serve the frozen model: taken when clearly better, left when worse."""
        learnt, frozen = sqrt(self.short_V2), sqrt(self.frozen_short_V2)
        if not self.fallback and learnt > FALLBACK_RATIO * frozen + floor_V:
            self.fallback = True
        elif self.fallback and learnt < frozen:
            self.fallback = False
        self.fallen_s = self.fallen_s + step_s if self.fallback else 0.0
        return self.fallback

    @shared
    def rolled_back(self) -> None:
        """The learner has returned to an earlier estimate: count the time of the frozen model from zero."""
        self.fallen_s = 0.0

    def add_doubt(self, variance_V2: float) -> None:
        """Add to the stated variance for a jump whose cause is open, V²."""
        self.doubt_V2 += variance_V2

    @property
    def std_V(self) -> float:
        """Standard deviation of the learner's predictions, V: the larger of long and short term."""
        return sqrt(max(self.long_V2, self.short_V2))

    @property
    def recent_V(self) -> float:
        """Rms error over the short term, V."""
        return sqrt(self.short_V2)

    @property
    def variance_V2(self) -> float:
        """Variance behind the stated uncertainty: the larger of long and short term, plus ``doubt_V2``."""
        return max(self.long_V2, self.short_V2) + self.doubt_V2


# --- The envelope: bounds on the learnt model around the identified one, from the physics of piezo stages.
#
# A model outside the envelope is not served: the last good model or the identified one stays in service.


@dataclass(frozen=True, slots=True)
class EnvelopeConfig:
    """Bounds about the identified model.

    The gain of a piezo stage changes by a few percent with temperature and age, by 20 to 30 % with amplitude and load.

    gain : largest factor of change of the gain of stage or sensor, up or down.
    offset : share of the range by which the zero may move.
    shape : share of the voltage span by which the model may leave the identified linear part, at every point.
    jump : largest jump, share of the range, accepted without motion that confirms it.
    drift_per_s : largest drift of the readings away from the voltage, share of the range a second.
    follow_s : motion for which readings must follow the drive before they are trusted again.
    """

    gain: float = 1.35
    offset: float = 0.3
    shape: float = 0.25
    jump: float = 0.12
    drift_per_s: float = 0.8
    follow_s: float = 0.15

    def __post_init__(self) -> None:
        if not (np.isfinite(self.gain) and self.gain > 1.0):
            raise InputError(f"envelope.gain: got {self.gain}, expected a factor above 1")
        for name in ("offset", "shape", "jump", "drift_per_s", "follow_s"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0.0):
                raise InputError(f"envelope.{name}: got {value}, expected a positive finite number")

    def refuses(self, base: FeatureMap, frame: FeatureMap) -> str:
        """Why a frame is outside, or ""."""
        gain = frame.gain / base.gain
        if not 1.0 / self.gain <= gain <= self.gain:
            return f"gain {gain:.3f} of the identified, allowed {1.0 / self.gain:.3f} to {self.gain:.3f}"
        range_um = base.y_max_um - base.y_min_um
        shift_um = _at_rest(frame) - _at_rest(base)
        if not abs(shift_um) <= self.offset * range_um:
            return f"zero moved by {shift_um:.3g} µm, allowed {self.offset * range_um:.3g} µm"
        return ""

    def gain_allows(self, gain: float) -> bool:
        """Whether readings that move ``gain`` times as far as the reckoned stage can come from a sound sensor."""
        return bool(1.0 / self.gain <= gain <= self.gain)


def _at_rest(frame: FeatureMap) -> float:
    """Reading, µm, where the identified stage rests without voltage."""
    return frame.offset_um + frame.gain * frame.y_rest_um
