"""Linearised gains of all cause models on one residual, and how often chance alone gains as much."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from adaptive.types import BoolArray, FloatArray
from sim.diagnosis.model.calibration import ModelFit
from sim.diagnosis.model.fit_data import ActsOn
from sim.diagnosis.model.stage_model import StageModel
from sim.diagnosis.search.held_out import Split, unit_columns


@dataclass(frozen=True)
class ScreenedCause:
    """One linearised guess: which form, from which start, and what it could remove of the squared error."""

    index: int
    start: FloatArray
    gain_um2: float
    slopes: FloatArray  # (columns, blocks): inner products with the residual, block by block
    gram: FloatArray
    #: Largest squared norm of any guess: what the cause would leave in this record at its usual size.
    size_um2: float = 0.0


class ResidualScreen:
    """The residual of a calibrated model, seen beside what its own numbers could still explain."""

    def __init__(self, fit: ModelFit, mask: BoolArray, parts: Split) -> None:
        self.fit, self.mask, self.parts = fit, mask, parts
        rows = unit_columns(fit, mask)
        q, _ = np.linalg.qr(rows.T)
        self.tangent = np.ascontiguousarray(q.T)
        residual = fit.residual_um * mask
        self.residual = residual - (residual @ q) @ q.T

    def project(self, rows: FloatArray) -> FloatArray:
        """Rows less what the model's own numbers explain of them."""
        rows = rows * self.mask
        return np.asarray(rows - (rows @ self.tangent.T) @ self.tangent)

    def differences(self, model: StageModel, trial: list[FloatArray]) -> FloatArray:
        """Simulated differences of a trial from the present model, (columns, n). ``model`` has one form more."""
        base = self.fit.signals
        parameters = model.nominal.parameters(model.data)
        own = model.causes[-1]
        start = min(s.acts_on for s in own.parameters(model.data))
        # Signals kept at other sub-steps cannot be gone on from.
        if model.substeps != self.fit.model.substeps or model.continuous != self.fit.model.continuous:
            start = ActsOn.DRIVE
        p = self.fit.p.copy()
        for i, parameter in enumerate(parameters):
            if parameter.name in own.pins:
                p[i] = parameter.neutral
        rows = [model.simulate(np.concatenate([p, q]), start, base).reading_um - base.reading_um for q in trial]
        return np.array(rows)

    def look(self, index: int, model: StageModel) -> ScreenedCause | None:
        """The best trial of the last form of ``model``, or None where none shows at all."""
        cause, data = model.causes[-1], model.data
        parameters = cause.parameters(data)
        neutral = np.array([s.neutral for s in parameters])
        best: ScreenedCause | None = None
        seen = 0.0
        for trial in cause.guesses(data, self.residual):
            rows = self.differences(model, trial)
            if not np.all(np.isfinite(rows)) or float(np.max(np.abs(rows))) > 1e3 * data.range_um:
                continue
            rows = self.project(rows)
            gram = rows @ rows.T
            size = np.diag(gram).copy()
            seen = max(seen, float(np.max(size)))
            if not np.any(size > 0.0) or not np.all(np.isfinite(gram)):
                continue
            slopes = self.parts.blocks(rows * self.residual)
            slope = slopes.sum(axis=1)
            scale = 1.0 / np.sqrt(np.where(size > 0.0, size, 1.0))
            system = gram * scale[:, None] * scale[None, :] + 1e-8 * np.eye(size.size)
            weights = scale * np.linalg.solve(system, scale * slope)
            if len(trial) == 1:
                # One guess of a number that does not simply scale: near its own size it is to be believed.
                weights = np.clip(weights, 0.0, 2.0)
                start = trial[0]
            else:
                start = trial[0].copy()
                moves = np.array([q - neutral for q in trial])
                # A number that only one of the guesses moves scales; one that all of them share stands.
                linear = np.count_nonzero(moves, axis=0) <= 1
                start[linear] = (neutral + weights @ moves)[linear]
            gain = float(2.0 * weights @ slope - weights @ gram @ weights)
            if best is None or gain > best.gain_um2:
                best = ScreenedCause(index, start, gain, slopes, gram)
        return None if best is None else replace(best, size_um2=seen)


def p_value(looks: list[ScreenedCause], gain_um2: float, seed: int, draws: int = 999) -> float:
    """How often chance alone would gain as much with the best of all these guesses.

    The blocks of the residual get random signs (a wild block bootstrap): what repeats with the drive loses its
    phase, while colour and uneven size of the noise stay. The largest gain of all candidates counts, which
    corrects for their number.
    """
    if not looks:
        return 1.0
    signs = np.random.default_rng(seed).choice([-1.0, 1.0], size=(draws, looks[0].slopes.shape[1]))
    top = np.zeros(draws)
    for look in looks:
        size = np.diag(look.gram)
        scale = 1.0 / np.sqrt(np.where(size > 0.0, size, 1.0))
        system = look.gram * scale[:, None] * scale[None, :] + 1e-8 * np.eye(size.size)
        b = scale[:, None] * (look.slopes @ signs.T)
        top = np.maximum(top, np.einsum("ij,ij->j", b, np.linalg.solve(system, b)))
    return float((1 + np.count_nonzero(top >= gain_um2)) / (draws + 1))
