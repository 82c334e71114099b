"""Linearised gains of all cause models on one residual, and how often chance alone gains as much."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dehyst.adaptive.types import BoolArray, FloatArray
from dehyst.sim.diagnosis.search.held_out import Split, unit_columns
from dehyst.sim.fitting.fit_data import ActsOn
from dehyst.sim.fitting.stage_model import ModelFit, StageModel


@dataclass(frozen=True)
class ScreenedCause:
    """The best linearised guess of one cause: its start values and how much squared error it could remove."""

    index: int
    start: FloatArray
    gain_um2: float
    slopes: FloatArray  # (columns, blocks): inner products with the residual, block by block
    gram: FloatArray
    #: Largest squared norm of any guess: the effect of the cause at its usual size on this recording.
    size_um2: float = 0.0


class ResidualScreen:
    """The residual of a calibrated model without what its own parameters could still explain."""

    def __init__(self, fit: ModelFit, mask: BoolArray, parts: Split) -> None:
        self.fit, self.mask, self.parts = fit, mask, parts
        rows = unit_columns(fit, mask)
        q, _ = np.linalg.qr(rows.T)
        self.tangent = np.ascontiguousarray(q.T)
        residual = fit.residual_um * mask
        self.residual = residual - (residual @ q) @ q.T

    def project(self, rows: FloatArray) -> FloatArray:
        """``rows`` (m, n) without the part that the model's own parameters can explain."""
        rows = rows * self.mask
        return np.asarray(rows - (rows @ self.tangent.T) @ self.tangent)

    def differences(self, model: StageModel, trial: list[FloatArray]) -> FloatArray:
        """(m, n) simulated differences of a guess from the present model. ``model`` has one cause more."""
        base = self.fit.signals
        parameters = model.nominal.parameters(model.data)
        own = model.causes[-1]
        start = min(s.acts_on for s in own.parameters(model.data))
        # Kept signals can only be used with the same sub-steps.
        if model.substeps != self.fit.model.substeps or model.continuous != self.fit.model.continuous:
            start = ActsOn.DRIVE
        p = self.fit.p.copy()
        for i, parameter in enumerate(parameters):
            if parameter.name in own.pins:
                p[i] = parameter.neutral
        rows = [model.simulate(np.concatenate([p, q]), start, base).reading_um - base.reading_um for q in trial]
        return np.array(rows)

    def best_guess(self, index: int, model: StageModel) -> ScreenedCause | None:
        """The best guess of the last cause of ``model``, or None if no guess changes the reading."""
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
                # A single guess is nonlinear in its parameter: allow only a factor of 0 to 2.
                weights = np.clip(weights, 0.0, 2.0)
                start = trial[0]
            else:
                start = trial[0].copy()
                moves = np.array([q - neutral for q in trial])
                # Parameters that only one vector moves scale linearly; shared ones keep their value.
                linear = np.count_nonzero(moves, axis=0) <= 1
                start[linear] = (neutral + weights @ moves)[linear]
            gain = float(2.0 * weights @ slope - weights @ gram @ weights)
            if best is None or gain > best.gain_um2:
                best = ScreenedCause(index, start, gain, slopes, gram)
        return None if best is None else replace(best, size_um2=seen)


#: Lengths over which the residual keeps its sign in a draw, in blocks of half a second: noise may be slower than those.
_RUNS = (1, 2, 4)


def p_value(looks: list[ScreenedCause], gain_um2: float, seed: int, draws: int = 999) -> float:
    """Probability that chance alone gains ``gain_um2`` with the best of all these guesses.

    A wild block bootstrap gives the blocks of the residual random signs. This destroys the relation to the drive and
    keeps colour and varying size of the noise. The maximum over all candidates corrects for their number. The largest
    of the probabilities with blocks of 0.5, 1 and 2 s counts: slow noise passes for a loop with shorter ones.
    """
    if not looks:
        return 1.0
    whitened = []
    for look in looks:
        size = np.diag(look.gram)
        scale = 1.0 / np.sqrt(np.where(size > 0.0, size, 1.0))
        system = look.gram * scale[:, None] * scale[None, :] + 1e-8 * np.eye(size.size)
        whitened.append((np.linalg.inv(system), scale[:, None] * look.slopes))
    found = []
    for run in _RUNS:
        starts = np.arange(0, looks[0].slopes.shape[1], run)
        signs = np.random.default_rng(seed).choice([-1.0, 1.0], size=(draws, starts.size))
        top = np.zeros(draws)
        for inverse, slopes in whitened:
            b = np.add.reduceat(slopes, starts, axis=1) @ signs.T
            top = np.maximum(top, np.einsum("ij,ij->j", b, inverse @ b))
        found.append((1 + np.count_nonzero(top >= gain_um2)) / (draws + 1))
    return float(max(found))
