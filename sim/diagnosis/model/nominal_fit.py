"""Calibration of the nominal stage: its hold, its start, its memory, before anything is called missing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from adaptive.types import BoolArray
from sim.diagnosis.model.chain import Model
from sim.diagnosis.model.dynamics import respond
from sim.diagnosis.model.fit import Fit, calibrate
from sim.diagnosis.model.forms import Form
from sim.diagnosis.model.measured import Setting
from sim.diagnosis.model.nominal import BoucWen, Linear, Nominal
from sim.diagnosis.model.nominal_stage import stage_nominal
from sim.stage.config import StageConfig

#: Nominal stages that go by a name.
NAMED = ("bouc_wen", "linear")


def begins_at_rest(setting: Setting) -> bool:
    """True where the drive stands at (or within 1 % of the swing of) zero volts for the first 20 ms."""
    first = setting.u_V[: max(3, round(0.02 / setting.dt_s))]
    return bool(np.max(np.abs(first)) < 0.01 * setting.swing_V)


def candidates(kind: str | StageConfig, setting: Setting) -> list[Nominal]:
    """The nominal stage with either hold between two samples: recorders differ in how they see the drive."""
    if isinstance(kind, StageConfig):
        stage = stage_nominal(kind)
        return [stage, stage.with_other_hold()]
    if kind == "linear":
        return [Linear("zero"), Linear("first")]
    free = not begins_at_rest(setting)
    return [BoucWen("zero", free_memory=free), BoucWen("first", free_memory=free)]


def nominal_setting(kind: str | StageConfig, setting: Setting) -> Setting:
    """The setting, knowing what kind of nominal stage it is compared with."""
    if not isinstance(kind, StageConfig):
        linear = kind == "linear"
        return replace(setting, input_is_linear=linear, nominal_kind=kind, has_mode=linear)
    stage = stage_nominal(kind)
    known = tuple(f for f, damping in stage.modes_hz if damping < 0.5)
    return replace(
        setting, input_is_linear=not stage.has_loop, nominal_kind="stage", known_modes_hz=known, has_mode=bool(known)
    )


def calibrated(kind: str | StageConfig, setting: Setting, mask: BoolArray, forms: tuple[Form, ...] = ()) -> Fit:
    """The nominal stage's best calibration, from several starts, within its physical bounds."""
    best: Fit | None = None
    for nominal in candidates(kind, setting):
        model = Model(setting, nominal, forms)
        for start in nominal.starts(setting):
            p = np.concatenate([start, *(np.array([s.neutral for s in f.slots(setting)]) for f in forms)])
            fit = calibrate(model, p, mask, 8, 1e-2)
            # A straight way between two samples is the dearer and the rarer assumption: it has to be worth it.
            dearer = best is not None and nominal.substeps > best.model.nominal.substeps
            if best is None or fit.sse_um2 < best.sse_um2 * (0.95 if dearer else 1.0 - 1e-3):
                best = fit
    assert best is not None
    return calibrate(best.model, best.p, mask, 12, 1e-5)


def with_other_axis(fit: Fit, mask: BoolArray, *, refit: bool = True) -> Fit:
    """The same fit in a setting that knows the other axis' displacement.

    It is that measured, where it was; else that of a like stage under the other axis' voltage. Its rate comes from
    the latter where there is one, because differences of readings are mostly noise.
    """
    setting = fit.model.setting
    modelled = None
    if setting.u2_V is not None and float(np.ptp(setting.u2_V)) > 1e-9:
        mine = fit.model.part(fit.p, -1)
        _, w = fit.model.nominal.static(setting.u2_V, mine, setting)
        modelled = respond(w, fit.model.dynamics(fit.p), setting.dt_s)
    measured = setting.y2_um
    if measured is not None and float(np.ptp(measured)) <= 0.0:
        measured = None
    other = measured if measured is not None else modelled
    if other is None:
        return fit
    other = other - float(np.mean(other[: max(1, setting.n // 500)]))
    source = modelled if modelled is not None else other
    known = replace(setting, other_um=other, other_um_per_s=np.gradient(source, setting.dt_s))
    known.scaled_as(setting)
    model = Model(known, fit.model.nominal, fit.model.forms)
    return calibrate(model, fit.p, mask, 2, 1e-4) if refit else replace(fit, model=model)
