"""One answer, safe to apply: the model's own, blended with a stand-in where the model is not trusted.

Everything here is a pure function of a snapshot and a query. The service answers by it, and so does a follower in
its own process, so that both give the same voltages to the last bit.

The weights are those of `service.answers.which_model`. The stand-in is a baseline whose form bounds what it says far
from its data.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dehyst.adaptive.compiled import all_finite
from dehyst.adaptive.types import Feedforward, FloatArray, InverseModel
from dehyst.service.answers.guard import Limits, guard, guarded
from dehyst.service.answers.slices import Pace, in_slices
from dehyst.service.answers.which_model import domain_weight, log_model_error
from dehyst.service.protocol.model import StandIn
from dehyst.service.protocol.query import (
    BLENDED,
    NOT_FINITE_REPLACED,
    OUTSIDE_DOMAIN,
    STALE,
    STAND_IN,
    Answer,
    Trajectory,
)

# --- Answers with a stand-in.

#: Time constant with which the difference between two snapshots fades, s, and the least of it, in samples.
FADE_S, FADE_SAMPLES = 0.006, 6.0


class Rules(NamedTuple):
    """How far a model is trusted.

    Attributes
    ----------
    limits : of the voltages. blend_share : distance from the learnt domain, as a share of the learnt span, at which the
    stand-in answers alone. trust : weight of the model inside its domain, 0 to 1. stale : flag every point STALE.
    """

    limits: Limits
    blend_share: float = 0.5
    trust: float = 1.0
    stale: bool = False


def answer_safely(
    model: InverseModel,
    memory: FloatArray,
    points: tuple[FloatArray, FloatArray, FloatArray],
    u_before_V: float,
    rules: Rules,
    stand_in: StandIn | None,
    blends: bool = True,
    resumes_V: float = math.nan,
    pace: Pace | None = None,
) -> Trajectory:
    """Voltages for (n,) points (y µm, v µm/s, a µm/s²) from ``memory`` (m,) on; never raises.

    ``blends``: whether ``model`` is one that gives way to ``stand_in`` outside its domain and by its trust; where not,
    the stand-in serves for what is not finite alone.
    ``resumes_V``: where finite, the first of the points was commanded already, with this voltage, V, and is not
    answered again: (n - 1,) come out. What the model asks for more or less there fades with ``FADE_S``, so that no new
    snapshot steps the voltage: a step would make the stage ring.
    ``pace``: evaluate in slices, with this between them; the answer is the same.
    """
    if math.isfinite(resumes_V):
        return _resumed(model, memory, points, u_before_V, rules, stand_in, blends, resumes_V, pace)
    forward = _forward(in_slices(model, pace), points, memory)
    u, std = forward.u_V, forward.std_V
    after_ok = all_finite(forward.memory)
    trusted = not blends or rules.trust >= 1.0
    if trusted and after_ok and not rules.stale:
        # Almost every answer: the model is trusted, inside its domain and finite.
        safe, flags, found = guarded(u, forward.inside, model.dt_s, rules.limits, u_before_V)
        if not found & (NOT_FINITE_REPLACED | (OUTSIDE_DOMAIN if blends else 0)):
            return Answer(safe, std, flags, forward.memory)
    finite = np.isfinite(u)
    ok = bool(finite.all())
    marks: NDArray[np.uint8] | None = None
    name = ""
    if not ok or not trusted or (blends and not forward.inside.all()):
        weight = np.ones(u.size)
        if blends:
            weight = rules.trust * domain_weight(model, forward, points, rules.blend_share)
        if stand_in is not None:
            u, std, marks = _mix(forward, weight, finite, _forward(stand_in.model, points, stand_in.memory))
            name = stand_in.name if marks.any() else ""
        if not ok:
            marks = np.zeros(u.size, dtype=np.uint8) if marks is None else marks
            marks[~finite] |= NOT_FINITE_REPLACED
    safe, flags = guard(u, forward.inside, model.dt_s, rules.limits, u_before_V)
    if marks is not None:
        flags |= marks
    if rules.stale:
        flags |= STALE
    fallback = not ok or not after_ok or not trusted
    return Answer(safe, std, flags, forward.memory if after_ok else memory, fallback=fallback, stand_in=name)


def _resumed(
    model: InverseModel,
    memory: FloatArray,
    points: tuple[FloatArray, FloatArray, FloatArray],
    u_before_V: float,
    rules: Rules,
    stand_in: StandIn | None,
    blends: bool,
    resumes_V: float,
    pace: Pace | None,
) -> Trajectory:
    free = rules._replace(limits=replace(rules.limits, slew_V_per_s=math.inf))
    got = answer_safely(model, memory, points, math.nan, free, stand_in, blends, pace=pace)
    n = got.u_V.size - 1
    fade = np.exp(-np.arange(1, n + 1) / max(FADE_S / model.dt_s, FADE_SAMPLES))
    limits, marks = rules.limits, got.flags[1:]
    u_V = got.u_V[1:] + (resumes_V - got.u_V[0]) * fade
    safe, flags = guard(u_V, (marks & OUTSIDE_DOMAIN) == 0, model.dt_s, limits, u_before_V)
    return got._replace(u_V=safe, std_V=got.std_V[1:], flags=flags | marks)


def _forward(model: InverseModel, points: tuple[FloatArray, FloatArray, FloatArray], memory: FloatArray) -> Feedforward:
    """The model's answer; NaN where it raises, which no model may."""
    try:
        return model.feedforward(*points, memory)
    except Exception as error:
        log_model_error(model, error)
        nothing = np.full(points[0].size, math.nan)
        return Feedforward(nothing, nothing, np.zeros(points[0].size, dtype=np.bool_), memory)


@np.errstate(all="ignore")  # an absurd memory gives absurd voltages, which the guard limits later
def _mix(
    forward: Feedforward, weight: FloatArray, finite: NDArray[np.bool_], other: Feedforward
) -> tuple[FloatArray, FloatArray, NDArray[np.uint8]]:
    """(voltages, deviations, flags) of the mixture; a stand-in that is not finite gets no weight."""
    usable = np.isfinite(other.u_V)
    w = np.where(finite, weight, 0.0)
    w = np.where(usable, w, 1.0)
    own = np.where(finite, forward.u_V, 0.0)
    there = np.where(usable, other.u_V, 0.0)
    u = np.where(w == 1.0, forward.u_V, there + w * (own - there))
    # Of a mixture of two: the variance of each, and that of their difference. A model without a stated one adds none.
    own_V2 = np.where(finite, np.nan_to_num(forward.std_V) ** 2, 0.0)
    there_V2 = np.nan_to_num(other.std_V) ** 2
    mixed = np.sqrt(w * own_V2 + (1.0 - w) * there_V2 + w * (1.0 - w) * (own - there) ** 2)
    std = np.where(w == 1.0, forward.std_V, np.where(w == 0.0, other.std_V, mixed))
    marks = np.where(w == 1.0, 0, np.where(w == 0.0, STAND_IN, BLENDED)).astype(np.uint8)
    return u, std, marks
