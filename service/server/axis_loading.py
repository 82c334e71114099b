"""From a model file and a configuration to an axis that can be served."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final

import numpy as np

from dehyst.adaptive.errors import ModelFileError
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.types import InverseModel, OnlineModel, Sample
from dehyst.baselines.competition.competition import Competition, Smooths
from dehyst.service.answers import guard
from dehyst.service.answers.guard import Limits
from dehyst.service.config.settings import COMPETE, AxisConfig
from dehyst.service.protocol.errors import FieldError
from dehyst.service.server.axis import Axis
from dehyst.service.server.learner_supervisor import champion_of
from dehyst.service.storage.model_file import Bundle, BundleMeta, read_bundle

#: Share of the identified range by which a desired point may lie beyond it where the configuration sets no limit.
RANGE_MARGIN: Final = 0.05
#: Enough for every step of the learner to have been taken, the rarer ones too.
_WARM_SAMPLES: Final = 400

#: Makes what learns from the model it starts from and the settings of the configuration.
LearnerFactory = Callable[[InverseModel, dict[str, Any], Limits], OnlineModel]


def make_learner(model: InverseModel, settings: dict[str, Any], limits: Limits) -> OnlineModel:
    """The learner of this project, started from ``model``. Raises InputError on an unknown setting."""
    from dehyst.adaptive.online.learner import Learner
    from dehyst.service.config.learner import learner_config

    if not isinstance(model, LssvmInverse):
        raise FieldError("learn", f"{model.name!r}, a {type(model).__name__}", "an LSSVM model of the file, or none")
    learner: OnlineModel = Learner.from_model(model, learner_config(settings, limits, "learner"))
    return learner


def load_axis(
    stage: str, config: AxisConfig, factory: LearnerFactory = make_learner, bundle: Bundle | None = None
) -> Axis:
    """The axis that ``config`` describes. Raises ModelFileError or InputError saying what does not fit."""
    bundle = bundle or read_bundle(config.model)
    for name, got, wanted in (("stage", bundle.meta.stage, stage), ("axis", bundle.meta.axis, config.name)):
        if got and got != wanted:
            raise ModelFileError(
                f"{config.model}: belongs to {name} {got!r}, but {wanted!r} is to be served; "
                f"name the right file, or identify this {name}"
            )
    models = dict(bundle.models)
    limits = _with_domain(config.limits, bundle.meta)
    for name in config.compete:
        if name not in models and name not in COMPETE:
            expected = f"one of the models in {config.model}: {', '.join(models)}, or of {', '.join(COMPETE)}"
            raise FieldError("compete", repr(name), expected)
    others = {name: models[name] for name in config.compete if name in models and name != config.learn}

    def begin(model: InverseModel) -> OnlineModel:
        """What learns from ``model``, against the online forms of the others; alone where none has one."""
        learner = factory(model, config.learner, limits)
        if not others or not isinstance(model, LssvmInverse) or not isinstance(learner, Smooths):
            return learner
        made = Competition.from_models(config.learn, learner, model, others, config.competition)
        return made if len(made.names) > 1 else learner

    learner = None
    if config.learn:
        if config.learn not in models:
            raise FieldError(
                "learn", repr(config.learn), f'one of the models in {config.model}: {", ".join(models)}, or "" for none'
            )
        try:
            learner = begin(models[config.learn])
            # Compiled loops are loaded by use; a second learner takes that on itself, and is thrown away.
            warmed = begin(models[config.learn])
            _warm_learner(warmed, limits)
        except ArithmeticError as error:  # numbers that are finite and that no stage has
            raise ModelFileError(
                f"{config.model}: model {config.learn!r} cannot learn: {error}; identify the stage again"
            ) from error
        models |= champion_of(learner)
    warnings = _warnings(limits, bundle.meta)
    if config.learn and 1.0 / bundle.meta.dt_s > _CERTAIN_HZ:
        warnings |= _rate_warning(warmed, limits)
    axis = Axis(config, models, learner, limits, begin, stage=stage, warnings=warnings)
    _warm_models(axis)
    return axis


#: Share of the model's voltages by which the limits may be narrower without a warning.
_NARROWER: Final = 0.05
#: Rate, Hz, that one thread sustains everywhere; above it the learner's speed is measured at the start.
_CERTAIN_HZ: Final = 4000.0
#: Share of the measured speed up to which a rate is sustained: other threads need the processor too.
_SUSTAINED: Final = 0.8


def _warnings(limits: Limits, meta: BundleMeta) -> dict[str, str]:
    """What does not fit between limits and model, and what was wrong with its recording; by name of the event."""
    found = {}
    low, high = meta.u_min_V, meta.u_max_V
    if low is not None and high is not None:
        margin = _NARROWER * (high - low)
        if limits.u_min_V > low + margin or limits.u_max_V < high - margin:
            found["limits_narrow"] = (
                f"the limits of {limits.u_min_V:g} to {limits.u_max_V:g} V are narrower than the {low:g} to {high:g} V "
                "of the model's recording: positions that need more are answered with a voltage at the limit"
            )
    clipped = meta.notes.get("clipped")
    if isinstance(clipped, list) and clipped:
        found["model_clipped"] = (
            f"the model was identified from a clipped recording ({'; '.join(map(str, clipped))[:200]}): it is wrong "
            "where the sensor or the amplifier was at its end; record again within their range"
        )
    return found


def _rate_warning(learner: OnlineModel, limits: Limits) -> dict[str, str]:
    """A warning where one thread cannot learn as many samples as the stage sends, by a trial of 400 samples."""
    learner.resync()
    model = learner.snapshot()
    dt_s = model.dt_s
    low, high = limits.y_min_um, limits.y_max_um
    if not math.isfinite(high - low):
        return {}
    t_s = np.arange(_WARM_SAMPLES + 200) * dt_s
    phase = 2.0 * np.pi * 5.0 * t_s
    half = 0.3 * (high - low)
    y, v, a = 0.5 * (low + high) - half * np.cos(phase), half * 31.4 * np.sin(phase), half * 987.0 * np.cos(phase)
    u_V = model.feedforward(y, v, a, model.rest_memory(float(y[0]))).u_V
    samples = [Sample(k, float(t_s[k]), float(u_V[k]), float(y[k])) for k in range(len(t_s))]
    for sample in samples[:200]:
        learner.handle(sample)
    begun = time.perf_counter()
    for sample in samples[200:]:
        learner.handle(sample)
    per_s = (len(samples) - 200) / (time.perf_counter() - begun)
    if per_s * _SUSTAINED >= 1.0 / dt_s:
        return {}
    return {
        "rate_too_high": (
            f"the stage sends {1.0 / dt_s:.0f} samples/s and one thread learns about {per_s:.0f} here: they will be "
            "thinned, as the status then says; send fewer, or raise learner.learn_every and learner.filter_every"
        )
    }


def _with_domain(limits: Limits, meta: BundleMeta) -> Limits:
    low, high = limits.y_min_um, limits.y_max_um
    if meta.y_min_um is not None and meta.y_max_um is not None:
        margin = RANGE_MARGIN * (meta.y_max_um - meta.y_min_um)
        low = meta.y_min_um - margin if math.isinf(low) else low
        high = meta.y_max_um + margin if math.isinf(high) else high
    return replace(limits, y_min_um=low, y_max_um=high)


def _warm_learner(learner: OnlineModel, limits: Limits) -> None:
    middle, half = 0.5 * (limits.u_min_V + limits.u_max_V), 0.4 * (limits.u_max_V - limits.u_min_V)
    low = limits.y_min_um if math.isfinite(limits.y_min_um) else 0.0
    high = limits.y_max_um if math.isfinite(limits.y_max_um) else 1.0
    dt_s = learner.snapshot().dt_s
    for seq in range(_WARM_SAMPLES):
        phase = math.sin(0.1 * seq)
        y_um = 0.5 * (low + high) + 0.4 * (high - low) * phase
        learner.handle(Sample(seq, seq * dt_s, middle + half * phase, y_um))
    learner.warm()
    learner.snapshot()


def _warm_models(axis: Axis) -> None:
    guard.warm()
    served = axis.newest
    for name, model in served.models.items():
        for n in (1, 2):
            zero = np.zeros(n)
            memory = served.memories[name]
            model.feedforward(zero, zero, zero, memory)
            model.track(zero, zero, zero, zero, memory)
