"""Which model answers: the tables that decide it, and its name in status, metrics and events.

Three questions, in this order:

1. Which of a learner's models is served as the one that learns? `ModelChoice`, once a snapshot, by `RULES`: a row for
   each trouble.
2. How much of an answer is the stand-in's? A weight by the trust (a trouble that lasts, samples that do not come) and
   by the distance from what was learnt (`trust_by_age`, `domain_weight`).
3. What is that called? `answering`, by `ROWS`: the first row that holds.

All are functions of samples, snapshots and queries alone: a standby, a replay and a follower decide alike.
``python -m dehyst.service.answers.which_model`` prints the page ``docs/which_model.md``.
"""

from __future__ import annotations

import logging
import math
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from enum import Enum, StrEnum
from itertools import groupby
from typing import Annotated, Final, NamedTuple

import numpy as np

from dehyst.adaptive.inverse_model import DOMAIN_MARGIN, LssvmInverse
from dehyst.adaptive.state import Entry
from dehyst.adaptive.types import Feedforward, FloatArray, InverseModel
from dehyst.baselines.competition.champion import ChampionInverse
from dehyst.service.answers.guard import Limits
from dehyst.service.protocol.query import BLENDED, NOT_FINITE_REPLACED, STAND_IN


class Answering(StrEnum):
    """Which model answers where a query names none."""

    LEARNT = "learnt"
    IDENTIFIED = "identified"
    LAST_GOOD = "last_good"
    FROZEN = "frozen"
    RIVAL = "rival"
    BLENDED = "blended"
    STAND_IN = "stand_in"
    HELD = "held"


#: What each of them is, for people.
MODELS: Final = {
    Answering.LEARNT: "the newest model",
    Answering.IDENTIFIED: "the identified model",
    Answering.LAST_GOOD: "the last good model",
    Answering.FROZEN: "the model of the moment when an operator stopped learning",
    Answering.RIVAL: "another contestant than the learner",
    Answering.BLENDED: "a mixture of the model and the stand-in",
    Answering.STAND_IN: "the stand-in",
    Answering.HELD: "no model: the voltage before is held",
}

# --- The troubles: which model is served during each.


class Kept(Enum):
    """Which of the learner's models is served."""

    NEWEST = "the learner's newest"
    GOOD = "the last that was served"
    OLDER = "one served 0.5 to 1 s before"
    BEST = "of the newest, one from before and the identified the one with the smallest error on the last readings"


class Rule(NamedTuple):
    """What a trouble means for the model that learns.

    Attributes
    ----------
    answers, kept : which model is served. teaches : whether samples are learnt. returns : whether wrong samples may
    have been learnt before it was named, so that the learner returns to a state from before when it is over.
    """

    answers: Answering
    kept: Kept
    teaches: bool = True
    returns: bool = False


SENSOR_FROZEN: Final = "sensor_frozen"
SAMPLES_POISONED: Final = "samples_poisoned"
VOLTAGE_DIFFERS: Final = "voltage_differs"
MODEL_BAD: Final = "model_bad"
LEARNER_FAILED: Final = "learner_failed"
NOTHING_LEARNT: Final = "nothing_learnt"
_FINE: Final = Rule(Answering.LEARNT, Kept.NEWEST)
_WRONG: Final = Rule(Answering.LAST_GOOD, Kept.OLDER, teaches=False, returns=True)
_UNFIT: Final = Rule(Answering.LAST_GOOD, Kept.GOOD)
#: Fewest readings by which models are compared.
_FEWEST: Final = 10
#: By trouble; "" is none. Troubles that are not here, of the disk or of lost samples, change no model.
RULES: Final[Mapping[str, Rule]] = {
    "": _FINE,
    NOTHING_LEARNT: Rule(Answering.LAST_GOOD, Kept.BEST),
    SENSOR_FROZEN: _WRONG,
    SAMPLES_POISONED: _WRONG,
    "sensor_stuck": _WRONG,
    "sensor_sign": _WRONG,
    "sensor_gain": _WRONG,
    "sensor_foreign": _WRONG,
    "out_of_envelope": _WRONG,
    # No sample is learnt from the first that differs on, so the newest model is from before.
    VOLTAGE_DIFFERS: Rule(Answering.LAST_GOOD, Kept.GOOD, teaches=False),
    MODEL_BAD: _UNFIT,
    LEARNER_FAILED: _UNFIT,
}


def rule_of(trouble: str) -> Rule:
    """What ``trouble`` means for the model that learns."""
    return RULES.get(trouble, _FINE)


#: Models that the choice keeps: the last good one, and two from before, the older and the newer.
ROLES: Final = ("good", "mark", "next_mark")
#: Places at which a model is looked at, one after the other, as shares of the range.
_SWEEP: Final = np.array([0.1, 0.3, 0.5, 0.7, 0.9, 1.0, 0.8, 0.6, 0.4, 0.2, 0.0])


#: Distance from the identified model, as a share of the voltage range, that no drift explains.
INSANE_SHARE: Final = 1.0
#: Time without a sign of a trouble after which it is over, s.
RECOVER_S: Final = 0.5
#: Age from which a model counts as one from before a trouble, s.
MARK_S: Final = 0.5
#: Time in which the trust goes to 0 once a trouble has lasted for ``last_good_s``, and comes back, s.
RAMP_S: Final = 1.0


class ModelChoice:
    """Which model of a learner is served, and how far it is trusted. One thread calls it.

    Parameters
    ----------
    dt_s : sample time, s. limits : of the axis. last_good_s : time for which a trouble leaves the trust at 1, s.

    Attributes
    ----------
    trouble : name of the present trouble, "" for none. trust : weight of the served model, 0 to 1.
    good : the model that was judged fit to be served; None before the first.
    """

    trouble: Annotated[str, Entry("name of the present trouble, empty for none", among=tuple(RULES))]
    trust: Annotated[float, Entry("weight of the served model, 1 without trouble", low=0.0, high=1.0)]
    _seen: Annotated[int, Entry("samples at the last snapshot", low=0)]
    _since: Annotated[int, Entry("samples when the trouble began", low=0)]
    _clean: Annotated[int, Entry("samples without a sign of it", low=0)]
    _marked: Annotated[int, Entry("samples when the newer model from before was kept", low=0)]

    def __init__(self, dt_s: float, limits: Limits, last_good_s: float) -> None:
        self.trouble, self.trust = "", 1.0
        self._dt_s, self._limits, self._last_good_s = dt_s, limits, last_good_s
        # The good models: newest, and two marks of which the older one is at least ``mark_s`` old.
        self.good: InverseModel | None = None
        self._mark: InverseModel | None = None
        self._next_mark: InverseModel | None = None
        self._seen = self._since = self._clean = self._marked = 0

    @property
    def rule(self) -> Rule:
        """What the present trouble means."""
        return rule_of(self.trouble)

    def choose(
        self, now: int, candidate: InverseModel | None, identified: InverseModel | None, found: str = "",
        distrusts: bool = False, recent: Callable[[], FloatArray] = lambda: np.empty((4, 0)),
    ) -> InverseModel | None:  # fmt: skip
        """The model to serve: ``candidate`` or one from before; None: keep the present one. Once per snapshot.

        ``now`` : count of samples. ``candidate`` : the newest model, None if the learner has failed. ``identified`` :
        the one that it began with. ``found`` : what is wrong with samples or learner. ``distrusts`` : whether the
        learner has the sensor on trial. ``recent`` : returns (4, n), y, v, a and u of the last readings.
        """
        elapsed, self._seen = now - self._seen, now
        if rule_of(found).kept in (Kept.NEWEST, Kept.BEST):
            found = self._trouble_of_model(candidate, identified) or found
        if found:
            self._clean = 0
            if found != self.trouble:
                self._enter(found, now)
                if self.rule.kept is Kept.BEST:
                    self.good = _best((candidate, self._mark, identified), recent())
        elif self.trouble:
            self._clean += elapsed
            if self._clean * self._dt_s >= RECOVER_S:
                self.trouble = ""
        if candidate is not None:
            # On trial the learner has itself gone back to before the fault, which is better than an old snapshot.
            own = distrusts and self._is_sane(candidate, identified)
            if self.rule.kept is Kept.NEWEST or own:
                self.good = candidate
            if not self.trouble and (self._mark is None or (now - self._marked) * self._dt_s >= MARK_S):
                self._mark, self._next_mark, self._marked = self._next_mark or candidate, candidate, now
        old = bool(self.trouble) and (now - self._since) * self._dt_s > self._last_good_s
        step = elapsed * self._dt_s / RAMP_S
        self.trust = max(0.0, self.trust - step) if old else min(1.0, self.trust + step)
        return self.good

    def _enter(self, trouble: str, now: int) -> None:
        if not self.trouble:
            self._since = now
        self.trouble = trouble
        if self.rule.kept is Kept.OLDER and self._mark is not None:
            self.good = self._next_mark = self._mark

    def _trouble_of_model(self, candidate: InverseModel | None, identified: InverseModel | None) -> str:
        if candidate is None:
            return LEARNER_FAILED
        return "" if candidate is self.good or self._is_sane(candidate, identified) else MODEL_BAD

    def _is_sane(self, model: InverseModel, identified: InverseModel | None) -> bool:
        """Whether the model is finite over the range and no further from the identified one than drift explains."""
        limits = self._limits
        low, high = limits.y_min_um, limits.y_max_um
        if not (math.isfinite(low) and math.isfinite(high)):
            low, high, identified = 0.0, 1.0, None
        # Up and down over the range: on one branch alone a right model may be at its bound in most places.
        y = low + (high - low) * _SWEEP
        u = voltages_along(model, y)
        if not np.isfinite(u).all():
            return False
        if isinstance(model, LssvmInverse):
            still = np.zeros(y.size)
            if np.mean(model.at_bound(y, still, still, model.rest_memory(float(y[0])), u)) > 0.5:
                return False
        if identified is None:
            return True
        apart_V = np.abs(u - voltages_along(identified, y))
        most_V = INSANE_SHARE * (limits.u_max_V - limits.u_min_V)
        return bool((apart_V[np.isfinite(apart_V)] <= most_V).all())

    def models(self) -> dict[str, InverseModel]:
        """The models that are kept, by role; `keep` takes them back."""
        known = zip(ROLES, (self.good, self._mark, self._next_mark), strict=True)
        return {role: model for role, model in known if model is not None}

    def keep(self, models: Mapping[str, InverseModel]) -> None:
        """Continue with the kept ``models`` of a saved choice, by role."""
        self.good, self._mark, self._next_mark = (models.get(role) for role in ROLES)


def _best(models: Sequence[InverseModel | None], recent: FloatArray) -> InverseModel | None:
    """Of ``models`` the one with the smallest error on the readings (4, n), the first of equals or with too few."""
    errors_V = [
        math.inf if model is None else _error_V(model, recent) if recent.shape[1] >= _FEWEST else 0.0
        for model in models
    ]
    return models[int(np.argmin(errors_V))]


def _error_V(model: InverseModel, recent: FloatArray) -> float:
    try:
        y_um, v_um_per_s, a_um_per_s2, _ = recent
        u_V = model.feedforward(y_um, v_um_per_s, a_um_per_s2, model.rest_memory(float(y_um[0]))).u_V
    except Exception as error:
        log_model_error(model, error)
        return math.inf
    error_V = float(np.mean(np.abs(u_V - recent[3])))
    return error_V if math.isfinite(error_V) else math.inf


def voltages_along(model: InverseModel, y_um: FloatArray) -> FloatArray:
    """(n,) V at (n,) places, µm, that a slow motion passes in turn; NaN where the model fails."""
    zero = np.zeros(y_um.size)
    try:
        return model.feedforward(y_um, zero, zero, model.rest_memory(float(y_um[0]))).u_V
    except Exception as error:
        log_model_error(model, error)
        return np.full(y_um.size, math.nan)


# --- Errors that a model raises, which no model may: the answer is replaced, the reason is logged.

_LOGGER: Final = logging.getLogger("dehyst.model")
#: An error is logged again after this time, s; so many different ones are told apart.
_AGAIN_S: Final = 60.0
_MOST: Final = 64
_lock: Final = threading.Lock()
_logged: dict[tuple[str, str], float] = {}


def log_model_error(model: InverseModel, error: Exception) -> None:
    """Log what ``model`` raised, with its traceback, at most once a minute for each kind of model and error."""
    key = type(model).__name__, type(error).__name__
    now = time.monotonic()
    with _lock:
        if now - _logged.get(key, -_AGAIN_S) < _AGAIN_S or len(_logged) >= _MOST:
            return
        _logged[key] = now
    _LOGGER.error("%s raised %s: %s; its answer is replaced", *key, error, exc_info=error)


# --- The stand-in: how much of an answer is the model's.


def trust_by_age(age_s: float, stale_s: float, last_good_s: float) -> tuple[float, bool]:
    """(weight, stale) of a model whose newest sample is ``age_s`` old, s, where samples are expected.

    Stale from ``stale_s`` on (0: never); from ``last_good_s`` on the stand-in takes over within a second.
    """
    if stale_s == 0.0 or age_s <= stale_s:
        return 1.0, False
    return 1.0 - min(1.0, max(0.0, age_s - last_good_s)), True


def domain_weight(
    model: InverseModel, forward: Feedforward, points: tuple[FloatArray, FloatArray, FloatArray], blend_share: float
) -> FloatArray:
    """(n,) weight of the model by distance from its domain: 1 inside, 0 from ``blend_share`` spans outside on.

    With s the distance as a share of the learnt span, over ``blend_share``, it is 1 - s²(3 - 2s).
    """
    weight = forward.inside.astype(np.float64)
    bounds = domain_of(model)
    if forward.inside.all() or bounds is None:
        # A baseline is bounded by its own form: its points outside are only flagged.
        return np.ones(weight.size)
    distance = np.zeros(weight.size)
    for low_high, x in zip(bounds, points, strict=True):
        low, high = low_high
        span = high - low
        if math.isfinite(span) and span > 0.0:
            np.maximum(distance, np.maximum(low - x, x - high) / span, out=distance)
    s = np.clip(distance / blend_share, 0.0, 1.0)
    return np.where(forward.inside, 1.0, 1.0 - s * s * (3.0 - 2.0 * s))


def domain_of(model: InverseModel) -> list[tuple[float, float]] | None:
    """Bounds of y (µm), v (µm/s) and a (µm/s²) inside which ``model`` says "inside"; None where it has no bounds."""
    if isinstance(model, ChampionInverse):
        model = model.served
    if not isinstance(model, LssvmInverse):
        return None
    lows, highs = model.domain[::2].tolist(), model.domain[1::2].tolist()
    return [
        (low - DOMAIN_MARGIN * (high - low), high + DOMAIN_MARGIN * (high - low))
        for low, high in zip(lows, highs, strict=True)
    ]


# --- The word for it.


class Seen(NamedTuple):
    """What decides which model answers.

    Attributes
    ----------
    trouble : name of what is wrong with samples or learner, "" for nothing. weight : of the model, 0 to 1; the rest is
    the stand-in's. finite : whether a model gave a finite voltage. frozen : whether an operator has stopped learning.
    rival : whether another contestant than the learner is champion. learns : whether the default model learns.
    identified : whether what the learner serves is the identified model.
    """

    trouble: str = ""
    weight: float = 1.0
    finite: bool = True
    frozen: bool = False
    rival: bool = False
    learns: bool = True
    identified: bool = False


class Row(NamedTuple):
    """``answers`` where ``holds``; ``when`` says that in words."""

    answers: Answering
    when: str
    holds: Callable[[Seen], bool]


#: The first row that holds says which model answers.
ROWS: Final = (
    Row(Answering.HELD, "neither the model nor the stand-in gives a finite voltage", lambda s: not s.finite),
    Row(Answering.STAND_IN, "the weight of the model is 0", lambda s: s.weight <= 0.0),
    Row(Answering.BLENDED, "the weight of the model is between 0 and 1", lambda s: s.weight < 1.0),
    Row(Answering.RIVAL, "another contestant is champion", lambda s: s.rival),
    Row(Answering.FROZEN, "an operator has stopped learning", lambda s: s.frozen),
    Row(Answering.IDENTIFIED, "the default model does not learn", lambda s: not s.learns),
    Row(
        Answering.IDENTIFIED,
        "the identified model predicts better",
        lambda s: s.identified,
    ),
    Row(
        Answering.LAST_GOOD,
        "the samples are wrong, or the newest model is unfit",
        lambda s: rule_of(s.trouble).answers is Answering.LAST_GOOD,
    ),
    Row(Answering.LEARNT, "else", lambda s: True),
)


def answering(seen: Seen) -> Answering:
    """Which model answers."""
    return next(row.answers for row in ROWS if row.holds(seen))


def seen_in(flags: int, model: InverseModel | None, trouble: str = "") -> Seen:
    """What the ``flags`` of a point, the ``model`` that gave it and the ``trouble`` of its snapshot tell."""
    weight = 0.0 if flags & STAND_IN else 0.5 if flags & BLENDED else 1.0
    finite = weight < 1.0 or not flags & NOT_FINITE_REPLACED
    return Seen(trouble, weight, finite, rival=isinstance(model, ChampionInverse) and model.champion != 0)


def is_identified(model: InverseModel, identified: InverseModel) -> bool:
    """Whether ``model`` gives the answers of the ``identified`` one."""
    if not (isinstance(model, LssvmInverse) and isinstance(identified, LssvmInverse)):
        return model is identified
    pairs = ((model.beta, identified.beta), (model.alpha, identified.alpha), (model.support, identified.support))
    return model.features == identified.features and all(np.array_equal(*pair) for pair in pairs)


# --- The page.

_PAGE: Final = """\
# Which model answers

The field `answering` of the [status](protocol.md#status), the metric `dehyst_answering`, `Follower.answering` and the
text of the event `trouble` say it by one word. The decisions are in `service/answers/which_model.py`. This page is
generated: `python -m dehyst.service.answers.which_model > docs/which_model.md`.

| `answering` | what answers where a query names no model |
|---|---|
{models}

## States and transitions

The first row that holds decides. A trouble is over after {recover_s:g} s without a sign of it. A trouble that lasts for
`last_good_s`, or samples that are so old, take the weight from 1 to 0 within {ramp_s:g} s, and it comes back as fast.
It also falls with the [distance from what was learnt](protocol.md#limits-stand-in-and-flags), point by point. Champions
change by [margins](learner.md#competition).

| first of these | `answering` |
|---|---|
{rows}

## During a trouble

| trouble | `answering` | model | samples are learnt | afterwards the learner returns to a state from before |
|---|---|---|---|---|
{rules}

While the readings are on trial, what the learner itself has gone back to is served in place of a kept model. Other
[troubles](learner.md#troubles) (lost samples, the disk) change no model.
"""


def page() -> str:
    """The page in Markdown."""
    says = {True: "yes", False: "no"}
    return _PAGE.format(
        recover_s=RECOVER_S,
        ramp_s=RAMP_S,
        models="\n".join(f"| `{answers}` | {text} |" for answers, text in MODELS.items()),
        rows="\n".join(f"| {row.when} | `{row.answers}` |" for row in ROWS),
        rules="\n".join(
            f"| {', '.join(f'`{name}`' if name else 'none' for name in names)} | `{rule.answers}` | {rule.kept.value} "
            f"| {says[rule.teaches]} | {says[rule.returns]} |"
            for rule, names in groupby(RULES, key=RULES.__getitem__)
        ),
    )


if __name__ == "__main__":
    sys.stdout.write(page())
