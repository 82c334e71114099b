"""Watches what the samples and the learner do, and says which model may be served: the newest, the last good one, none.

Deterministic: a function of the samples and the learner's snapshots alone, so that a standby and a replay decide alike.
Trouble has a name, begins and ends with hysteresis, and ends by itself:

- ``sensor_frozen``: the reading has not moved at all for a while in which the voltage has.
- ``samples_poisoned``: most samples of the last while were refused for their values.
- ``model_bad``: the newest model is not finite, or far from every other, at places all over the range.
- ``learner_failed``: the learner raised; another is begun from the last good model after a while.
- ``sensor_stuck``, ``sensor_gain``, ``sensor_sign``, ``sensor_foreign``, ``out_of_envelope``: the learner says that the
  readings do not follow the drive as this stage's can (``adaptive.online.sensor_trial``).
- ``rail``, ``model_left_envelope``: the voltage was at a limit because the model was wrong, or the model had left what
  a stage can become; the learner has begun again from the identified one.

During the first two the learner is frozen and the model from before the trouble is served. Where the learner itself
distrusts the sensor, what it goes on serving is: it has gone back to before the fault. Where it has begun again, that
is the identified model; during the others it is the last that passed. What was served for too
long without being renewed gives way, over a ramp, to the baseline.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from adaptive.inverse_model import LssvmInverse
from adaptive.online.learner import MODEL_LEFT_ENVELOPE, RAIL
from adaptive.online.sensor_trial import SENSOR_FAULTS
from adaptive.types import FloatArray, InverseModel
from service.answers.guard import Limits

SENSOR_FROZEN: Final = "sensor_frozen"
SAMPLES_POISONED: Final = "samples_poisoned"
MODEL_BAD: Final = "model_bad"
LEARNER_FAILED: Final = "learner_failed"
#: After these the learner has begun again: the model from before is what was wrong.
BEGUN_AGAIN: Final = frozenset({RAIL, MODEL_LEFT_ENVELOPE})
#: During these the learner is not to be taught.
POISON: Final = frozenset({SENSOR_FROZEN, SAMPLES_POISONED}) | SENSOR_FAULTS
#: Refusals that speak of the values themselves; a stage at rest or out of sequence is no poison.
_BAD_VALUES: Final = frozenset({"not_finite", "timing", "glitch", "out_of_range", "numerics"})
_PROBES: Final = 9
#: Models that the watch keeps: the last good one, and two from before, the older and the newer.
ROLES: Final = ("good", "mark", "next_mark")


@dataclass(frozen=True, slots=True)
class ModelWatchConfig:
    """When to call it trouble.

    Attributes
    ----------
    frozen_s, frozen_share : a reading that stands still for this long, s, while the voltage moves by this share of its
    range, is frozen. poisoned_s, poisoned_share : that share of bad values over about that time, s.
    insane_share : distance of a model from the baseline, as a share of the voltage range, that no drift explains.
    recover_s : time without trouble, s, after which the newest model is served again.
    mark_s : age that a model reaches, s, before it counts as one from before the trouble.
    last_good_s, ramp_s : how long the last good model is served, s, and over what time, s, the baseline takes over.
    revive_s : time after which a learner that failed is begun anew, s.
    """

    frozen_s: float = 0.1
    frozen_share: float = 0.02
    poisoned_s: float = 0.25
    poisoned_share: float = 0.5
    insane_share: float = 1.0
    recover_s: float = 0.5
    mark_s: float = 0.5
    last_good_s: float = 60.0
    ramp_s: float = 1.0
    revive_s: float = 5.0


class ModelWatch:
    """State of the watch over one axis. One thread calls it.

    Attributes
    ----------
    trouble : name of what is wrong, empty while all is well. trust : weight of the served model, 1 while all is well.
    """

    def __init__(self, config: ModelWatchConfig, dt_s: float, limits: Limits) -> None:
        self.config = config
        self.trouble = ""
        self.trust = 1.0
        self._dt_s = dt_s
        self._span_V = limits.u_max_V - limits.u_min_V
        self._limits = limits
        # The good models: newest, and two marks of which the older one is at least ``mark_s`` old.
        self._good: InverseModel | None = None
        self._mark: InverseModel | None = None
        self._next_mark: InverseModel | None = None
        #: Plain numbers only, so that the state can be written down.
        self._n: dict[str, float] = {
            "count": 0, "still": 0, "y": math.nan, "u_low": math.inf, "u_high": -math.inf,
            "bad": 0.0, "marked": 0, "since": 0, "clean": 0, "seen": 0, "failed": 0,
        }  # fmt: skip

    def take(self, u_V: float, y_um: float, verdict: str) -> None:
        """One sample in order, and what the learner said of it."""
        n, c = self._n, self.config
        n["count"] += 1
        if y_um == n["y"]:
            n["still"] += 1
            n["u_low"], n["u_high"] = min(n["u_low"], u_V), max(n["u_high"], u_V)
        else:
            n["still"], n["y"], n["u_low"], n["u_high"] = 0, y_um, u_V, u_V
        # A sensor that repeats itself has trouble of its own name.
        bad = 1.0 if verdict in _BAD_VALUES and not n["still"] else 0.0
        n["bad"] += (bad - n["bad"]) * self._dt_s / c.poisoned_s

    def _samples_say(self) -> str:
        n, c = self._n, self.config
        # Once in trouble it takes less to stay in it.
        share = c.poisoned_share * (0.2 if self.trouble == SAMPLES_POISONED else 1.0)
        if n["bad"] > share:
            return SAMPLES_POISONED
        moved = n["u_high"] - n["u_low"] >= c.frozen_share * self._span_V
        if n["still"] * self._dt_s >= c.frozen_s and moved:
            return SENSOR_FROZEN
        return ""

    def judge(
        self, candidate: InverseModel | None, baseline: InverseModel | None, told: str = "", distrusts: bool = False
    ) -> InverseModel | None:
        """The model to serve, of ``candidate`` (None: the learner failed) and those before; None: nothing but what is.

        ``told``: what the learner says is wrong. ``distrusts``: whether it has the readings on trial.
        Call once per snapshot. Sets ``trouble`` and ``trust``.
        """
        n, c = self._n, self.config
        now, elapsed = n["count"], n["count"] - n["seen"]
        n["seen"] = now
        found = told or self._samples_say()
        if found in SENSOR_FAULTS and self.trouble in (SENSOR_FROZEN, SAMPLES_POISONED):
            found = self.trouble  # the same trouble, seen by another
        if not found and candidate is None:
            found = LEARNER_FAILED
        if not found and candidate is not None and candidate is not self._good and not self._sane(candidate, baseline):
            found = MODEL_BAD
        if found:
            n["clean"] = 0
            if found != self.trouble:
                if not self.trouble:
                    n["since"] = now
                if found in POISON and self._mark is not None:
                    # What came in before the trouble had its name may have been learnt.
                    self._good = self._next_mark = self._mark
                self.trouble = found
        elif self.trouble:
            n["clean"] += elapsed
            if n["clean"] * self._dt_s >= c.recover_s:
                self.trouble = ""
        if self.trouble in BEGUN_AGAIN and candidate is not None:
            self._mark = self._next_mark = self._good = candidate
        elif self.trouble and distrusts and candidate is not None and self._sane(candidate, baseline):
            # It has gone back to before the fault by itself, and knows more of before than one snapshot does.
            self._good = candidate
        if not self.trouble and candidate is not None:
            self._good = candidate
            if (now - n["marked"]) * self._dt_s >= c.mark_s or self._mark is None:
                self._mark, self._next_mark, n["marked"] = self._next_mark or candidate, candidate, now
        old = bool(self.trouble) and (now - n["since"]) * self._dt_s > c.last_good_s
        step = elapsed * self._dt_s / c.ramp_s
        self.trust = max(0.0, self.trust - step) if old else min(1.0, self.trust + step)
        return self._good

    def failed_long(self) -> bool:
        """Whether a learner that failed is to be begun anew; call once per snapshot while it is dead."""
        n = self._n
        if not n["failed"]:
            n["failed"] = n["count"]
        if (n["count"] - n["failed"]) * self._dt_s < self.config.revive_s:
            return False
        n["failed"] = 0
        return True

    @property
    def good(self) -> InverseModel | None:
        """The model that was judged fit to be served; None before the first."""
        return self._good

    @property
    def teachable(self) -> bool:
        """Whether the samples are fit to teach."""
        return self.trouble not in POISON

    def _sane(self, model: InverseModel, baseline: InverseModel | None) -> bool:
        """Finite all over the range, at rest, and not further from the baseline than any drift would bring it."""
        low, high = self._limits.y_min_um, self._limits.y_max_um
        if not (math.isfinite(low) and math.isfinite(high)):
            low, high = 0.0, 1.0
            baseline = None
        probes = np.linspace(low, high, _PROBES)
        u = _at_rest(model, probes)
        if not np.isfinite(u).all():
            return False
        if isinstance(model, LssvmInverse) and np.mean(model.at_bound(probes, u)) > 0.5:
            return False
        if baseline is None:
            return True
        other = _at_rest(baseline, probes)
        inside = np.isfinite(other)
        return bool((np.abs(u - other)[inside] <= self.config.insane_share * self._span_V).all())

    def models(self) -> dict[str, InverseModel]:
        """The good models by their part: those that :meth:`restore` wants back."""
        known = zip(ROLES, (self._good, self._mark, self._next_mark), strict=True)
        return {role: model for role, model in known if model is not None}

    def state_dict(self) -> dict[str, Any]:
        """Plain numbers and words; the models are not in it."""
        return {"trouble": self.trouble, "trust": self.trust, **self._n}

    def restored(self, state: dict[str, Any], models: dict[str, InverseModel]) -> ModelWatch:
        """A watch like this one that continues from ``state_dict`` and ``models``. Raises KeyError, ValueError."""
        made = ModelWatch(self.config, self._dt_s, self._limits)
        made._n = {name: float(state[name]) for name in self._n}
        made.trouble, made.trust = str(state["trouble"]), float(state["trust"])
        made._good, made._mark, made._next_mark = (models.get(role) for role in ROLES)
        return made


def _at_rest(model: InverseModel, y_um: FloatArray) -> FloatArray:
    zero = np.zeros(y_um.size)
    try:
        return model.feedforward(y_um, zero, zero, model.rest_memory(float(y_um[0]))).u_V
    except Exception:
        return np.full(y_um.size, math.nan)
