"""Decides which model of an axis may be served: the newest, the last good one, or gradually the baseline.

Deterministic: a function of the samples and of the learner's snapshots, so that a standby and a replay decide alike.
A trouble has a name, begins and ends with hysteresis, and ends by itself:

- ``sensor_frozen`` : the reading has not changed for a while in which the voltage has.
- ``samples_poisoned`` : most samples of the last while were refused for their values.
- ``model_bad`` : the newest model is not finite, or far from every other, at positions all over the range.
- ``learner_failed`` : the learner raised; another one is started from the last good model after a while.
- ``sensor_stuck``, ``sensor_gain``, ``sensor_sign``, ``sensor_foreign``, ``out_of_envelope`` : the learner reports that
  the readings do not follow the voltage as those of this stage can.
- ``rail``, ``model_left_envelope`` : the voltage was at a limit because the model was wrong, or the model has left
  the range in which a stage can be; the learner has restarted from the identified model.

During the first two, and while the learner distrusts the sensor, nothing is learnt. Which model is served meanwhile:
the last good one from before the trouble; the learner's own where it has itself gone back to before the fault; the
identified one where the learner has restarted. A model that was not renewed for ``last_good_s`` gives way to the
baseline over a ramp.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from adaptive.inverse_model import LssvmInverse
from adaptive.online.learner import MODEL_LEFT_ENVELOPE, RAIL
from adaptive.online.sensor_trust import SENSOR_FAULTS
from adaptive.types import FloatArray, InverseModel
from service.answers.fallback import log_model_error
from service.answers.guard import Limits

SENSOR_FROZEN: Final = "sensor_frozen"
SAMPLES_POISONED: Final = "samples_poisoned"
MODEL_BAD: Final = "model_bad"
LEARNER_FAILED: Final = "learner_failed"
#: After these the learner has restarted, because the model from before was wrong.
BEGUN_AGAIN: Final = frozenset({RAIL, MODEL_LEFT_ENVELOPE})
#: During these nothing is learnt.
POISON: Final = frozenset({SENSOR_FROZEN, SAMPLES_POISONED}) | SENSOR_FAULTS
#: Refusals for the values of a sample. A stage at rest, or a sample out of sequence, is no trouble.
_BAD_VALUES: Final = frozenset({"not_finite", "timing", "glitch", "out_of_range", "numerics"})
_PROBES: Final = 9
#: Models that the watch keeps: the last good one, and two from before, the older and the newer.
ROLES: Final = ("good", "mark", "next_mark")


@dataclass(frozen=True, slots=True)
class ModelWatchConfig:
    """Thresholds of the troubles.

    Attributes
    ----------
    frozen_s, frozen_share : the sensor is frozen if the reading does not change for this time, s, while the voltage
    changes by this share of its range.
    poisoned_s, poisoned_share : time constant, s, and share of bad values from which samples are poisoned.
    insane_share : distance from the baseline, as a share of the voltage range, that no drift explains.
    recover_s : time without trouble, s, after which the newest model is served again.
    mark_s : age, s, from which a model counts as one from before the trouble.
    last_good_s, ramp_s : times, s, for which the last good model is served, and in which the baseline takes over.
    revive_s : time, s, after which a failed learner is replaced.
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
    """The watch over one axis. One thread calls it.

    Attributes
    ----------
    trouble : name of the present trouble, "" for none. trust : weight of the served model, 0 to 1; 1 without trouble.
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
        #: Numbers only, so that they can be stored.
        self._n: dict[str, float] = {
            "count": 0, "still": 0, "y": math.nan, "u_low": math.inf, "u_high": -math.inf,
            "bad": 0.0, "marked": 0, "since": 0, "clean": 0, "seen": 0, "failed": 0,
        }  # fmt: skip

    def take(self, u_V: float, y_um: float, verdict: str) -> None:
        """Take one sample in order, with the learner's verdict."""
        n, c = self._n, self.config
        n["count"] += 1
        if y_um == n["y"]:
            n["still"] += 1
            n["u_low"], n["u_high"] = min(n["u_low"], u_V), max(n["u_high"], u_V)
        else:
            n["still"], n["y"], n["u_low"], n["u_high"] = 0, y_um, u_V, u_V
        # A repeated reading belongs to the trouble sensor_frozen.
        bad = 1.0 if verdict in _BAD_VALUES and not n["still"] else 0.0
        n["bad"] += (bad - n["bad"]) * self._dt_s / c.poisoned_s

    def _trouble_of_samples(self) -> str:
        n, c = self._n, self.config
        # Hysteresis: a lower share ends the trouble than begins it.
        share = c.poisoned_share * (0.2 if self.trouble == SAMPLES_POISONED else 1.0)
        if n["bad"] > share:
            return SAMPLES_POISONED
        moved = n["u_high"] - n["u_low"] >= c.frozen_share * self._span_V
        if n["still"] * self._dt_s >= c.frozen_s and moved:
            return SENSOR_FROZEN
        return ""

    def judge(
        self, candidate: InverseModel | None, baseline: InverseModel | None, reported: str = "", distrusts: bool = False
    ) -> InverseModel | None:
        """The model to serve: ``candidate`` or one from before; None: keep the present one. Once per snapshot.

        ``candidate`` : the newest model, None if the learner has failed. ``reported`` : the trouble that the learner
        reports. ``distrusts`` : whether it has the sensor on trial. Sets `trouble` and `trust`.
        """
        n, c = self._n, self.config
        now, elapsed = n["count"], n["count"] - n["seen"]
        n["seen"] = now
        found = reported or self._trouble_of_samples()
        if found in SENSOR_FAULTS and self.trouble in (SENSOR_FROZEN, SAMPLES_POISONED):
            found = self.trouble  # the same trouble, already named
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
                    # Bad samples from before the trouble had its name may have been learnt.
                    self._good = self._next_mark = self._mark
                self.trouble = found
        elif self.trouble:
            n["clean"] += elapsed
            if n["clean"] * self._dt_s >= c.recover_s:
                self.trouble = ""
        if self.trouble in BEGUN_AGAIN and candidate is not None:
            self._mark = self._next_mark = self._good = candidate
        elif self.trouble and distrusts and candidate is not None and self._sane(candidate, baseline):
            # The learner has itself gone back to before the fault, which is better than an old snapshot.
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
        """Whether to replace a failed learner now; call once per snapshot while it has failed."""
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
        """Whether the samples may be learnt."""
        return self.trouble not in POISON

    def _sane(self, model: InverseModel, baseline: InverseModel | None) -> bool:
        """Whether the model at rest is finite over the range and no further from the baseline than drift explains."""
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
        """The models that the watch keeps, by role; `restored` takes them back."""
        known = zip(ROLES, (self._good, self._mark, self._next_mark), strict=True)
        return {role: model for role, model in known if model is not None}

    def state_dict(self) -> dict[str, Any]:
        """Numbers and words, without the models."""
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
    except Exception as error:
        log_model_error(model, error)
        return np.full(y_um.size, math.nan)
