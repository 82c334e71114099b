"""References for the controllers: the response to (2.45), the chapter's shapes, and a family that it lacks."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from adaptive.smoothing import SmootherConfig, smooth_recording
from adaptive.types import FloatArray
from sim.chapter.experiments import DT_S, Experiments, Record
from sim.signals.references import Reference, blend_step, demo_reference
from sim.signals.sample_times import sample_times

#: Step of the central differences that give velocity and acceleration of a formula, s.
_STEP_S = 1e-4
#: Top of the references as a share of the motion range, so that they stay within the identified range.
_TOP = 0.9


def from_formula(formula: Callable[[FloatArray], FloatArray], duration_s: float, dt_s: float = DT_S) -> Reference:
    """Reference of a smooth formula y(t), µm; derivatives by central differences with 0.1 ms steps."""
    t = sample_times(duration_s, dt_s)
    now, before, after = formula(t), formula(t - _STEP_S), formula(t + _STEP_S)
    return Reference(t, now, (after - before) / (2.0 * _STEP_S), (after - 2.0 * now + before) / _STEP_S**2)


def chapter_reference(range_um: float, duration_s: float = 10.0) -> Reference:
    """(2.45) in displacement: its decaying sweep scaled to 90 % of the motion range."""
    scale = _TOP * range_um / 2.0

    def formula(t: FloatArray) -> FloatArray:
        wave = np.cos(3.0 * np.pi * t * np.exp(-0.092 * t) - np.pi) + 1.0
        return np.asarray(scale * np.exp(-0.14 * t) * wave, dtype=np.float64)

    return from_formula(formula, duration_s)


def training_reference(range_um: float, duration_s: float = 10.0) -> Reference:
    """(2.37) in displacement, scaled to 90 % of the range: the motion of the training record."""
    scale = _TOP * range_um / 2.0

    def formula(t: FloatArray) -> FloatArray:
        wave = np.sin(6.0 * np.pi * t * np.exp(-0.345 * t) - 0.5 * np.pi) + 1.0
        return np.asarray(scale * np.exp(-0.11 * t) * wave, dtype=np.float64)

    return from_formula(formula, duration_s)


def sine_reference(range_um: float, frequency_Hz: float = 5.0, duration_s: float = 4.0) -> Reference:
    """A sine from 0 to 80 % of the range, whose amplitude rises smoothly over the first half second."""

    def formula(t: FloatArray) -> FloatArray:
        size = blend_step(np.clip(t / 0.5, 0.0, 1.0))[0]
        return np.asarray(0.4 * range_um * size * (1.0 - np.cos(2.0 * np.pi * frequency_Hz * t)), dtype=np.float64)

    return from_formula(formula, duration_s)


def answered_reference(record: Record) -> Reference:
    """The displacement of the stage in a record, smoothed with zero phase, which is within its reach."""
    motion = smooth_recording(record.y_um, SmootherConfig.for_rate(DT_S))
    y, v, a = (np.ascontiguousarray(motion[:, i]) for i in range(3))
    return Reference(record.t_s, y, v, a)


def control_references(data: Experiments, quick: bool = False) -> dict[str, Reference]:
    """References by name; the first is that of Table 2.5, the last two are the family that the chapter lacks.

    The chapter only draws the reference of Fig. 2.17a. The first one here is the response of the stage to (2.45): it
    leaves rest and returns as the stage does. The second has the same shape but returns to 0 µm each time, which the
    training record never does. ``quick`` leaves out the two shapes in µm.
    """
    range_um = data.range_um
    found = {"answer to (2.45)": answered_reference(data.generalisation)}
    if not quick:
        found |= {"(2.45) in µm": chapter_reference(range_um), "(2.37) in µm": training_reference(range_um)}
    tones = demo_reference(7.0 if quick else 20.0, DT_S, (0.0, _TOP * range_um), seed=3)
    return found | {
        "sine 5 Hz": sine_reference(range_um, duration_s=2.0 if quick else 4.0),
        "tones, minor loops, holds": tones,
    }
