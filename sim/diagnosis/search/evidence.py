"""Held-out error, its null distribution and comparisons of models, all from sums over blocks of the record."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from adaptive.types import BoolArray, FloatArray
from sim.diagnosis.model.chain import Model
from sim.diagnosis.model.fit import Fit
from sim.diagnosis.model.measured import At, Setting

IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class Split:
    """Blocks of about half a second and folds of whole waveforms.

    ``edges`` (b + 1,) are the first samples of the blocks and n; ``fold`` (b,) is each block's fold.
    """

    edges: IntArray
    fold: IntArray

    @property
    def n_folds(self) -> int:
        return int(self.fold.max()) + 1

    def blocks(self, values: FloatArray) -> FloatArray:
        """Sums over the blocks along the last axis."""
        return np.asarray(np.add.reduceat(values, self.edges[:-1], axis=-1))

    def samples(self, fold: int) -> BoolArray:
        """Samples of one fold."""
        return np.repeat(self.fold == fold, np.diff(self.edges))


def split(setting: Setting, block_s: float = 0.5, n_folds: int = 4) -> Split:
    """Blocks, and folds that each leave out stretches of another waveform and rate.

    Neighbouring blocks whose drive is alike (the same rate within a factor of two, the same share of standing
    still) make one stretch; stretches longer than an eighth of the record are cut. Stretches go to the folds in turn.
    """
    block = max(8, min(round(block_s / setting.dt_s), setting.n // 40))
    count = max(1, setting.n // block)
    edges = np.append(np.arange(count) * block, setting.n).astype(np.int64)
    rate = np.maximum.reduceat(setting.rate_V_per_s, edges[:-1]) + 1e-3 * setting.swing_V
    mean = np.add.reduceat(setting.rate_V_per_s, edges[:-1]) / np.diff(edges) + 1e-3 * setting.swing_V
    key = np.stack([np.log2(rate), np.log2(mean)])
    fold = np.zeros(count, dtype=np.int64)
    longest, length, current, centre = max(1, count // 8), 0, 0, key[:, 0]
    for i in range(count):
        if length >= longest or (length >= 2 and np.max(np.abs(key[:, i] - centre)) > 1.0):
            current, length, centre = current + 1, 0, key[:, i]
        fold[i] = current % n_folds
        length += 1
    return Split(edges, fold)


@dataclass(frozen=True)
class HeldOut:
    """Squared error (µm²) of a calibrated model on data that its numbers have not seen, per block and in sum."""

    per_block_um2: FloatArray
    sse_um2: float


#: What happened before the record is known from its first moments alone, and cannot be held out with them.
PAST = ("start_um", "h0")


def _columns(fit: Fit, mask: BoolArray, past: bool = True) -> FloatArray:
    """Columns (as rows) of the numbers that can still move, masked and scaled to unit norm."""
    if fit.rows is not None:
        if not past:
            names = [fit.model.slots[i].name for i in fit.row_slots]
            fit = replace(fit, rows=fit.rows[[i for i, name in enumerate(names) if name not in PAST]])
        assert fit.rows is not None
        norms = np.sqrt(np.einsum("ij,ij->i", fit.rows, fit.rows))
        good = norms > 0.0
        return np.asarray(fit.rows[good] / norms[good, None])
    slots = fit.model.slots
    slope_free = [i for i in fit.free if slots[i].low < fit.p[i] < slots[i].high]
    if not past:
        slope_free = [i for i in slope_free if slots[i].name not in PAST]
    rows = fit.model.jacobian(fit.p, fit.signals, slope_free) * mask
    norms = np.sqrt(np.einsum("ij,ij->i", rows, rows))
    good = norms > 1e-9 * max(float(norms.max(initial=0.0)), 1e-300)
    return np.asarray(rows[good] / norms[good, None])


def held_out(fit: Fit, mask: BoolArray, parts: Split) -> HeldOut:
    """Leave-one-fold-out error of the model linearised at its calibration: exact where the model is linear."""
    rows = _columns(fit, mask, past=False)
    residual = fit.residual_um * mask
    per_block = parts.blocks(np.square(residual))
    grams, slopes = [], []
    for f in range(parts.n_folds):
        inside = parts.samples(f)
        part = rows[:, inside]
        grams.append(part @ part.T)
        slopes.append(part @ residual[inside])
    whole, slope = sum(grams), sum(slopes)
    # What only one stretch of the record determines (the first rise from rest, say) cannot be held out with it:
    # such directions stay where the whole record puts them.
    ridge = 1e-4 * np.eye(rows.shape[0])
    # A calibration stops a little short of its optimum. That step is the same with and without a fold: only what
    # leaving the fold out changes is evidence.
    short = np.linalg.lstsq(whole + 1e-9 * np.eye(rows.shape[0]), slope, rcond=1e-12)[0]
    out = np.zeros_like(per_block)
    for f in range(parts.n_folds):
        pull = slopes[f] - grams[f] @ short
        move = np.linalg.lstsq(whole - grams[f] + ridge, -pull, rcond=1e-12)[0]
        inside = parts.samples(f)
        left = np.zeros_like(residual)
        left[inside] = residual[inside] - move @ rows[:, inside]
        out += parts.blocks(np.square(left))
    return HeldOut(out, float(out.sum()))


@dataclass(frozen=True)
class Screened:
    """One linearised guess: which form, from which start, and what it could remove of the squared error."""

    index: int
    start: FloatArray
    gain_um2: float
    slopes: FloatArray  # (columns, blocks): inner products with the residual, block by block
    gram: FloatArray
    #: Largest squared norm of any guess: what the cause would leave in this record at its usual size.
    size_um2: float = 0.0


class Screen:
    """The residual of a calibrated model, seen beside what its own numbers could still explain."""

    def __init__(self, fit: Fit, mask: BoolArray, parts: Split) -> None:
        self.fit, self.mask, self.parts = fit, mask, parts
        rows = _columns(fit, mask)
        q, _ = np.linalg.qr(rows.T)
        self.tangent = np.ascontiguousarray(q.T)
        residual = fit.residual_um * mask
        self.residual = residual - (residual @ q) @ q.T

    def project(self, rows: FloatArray) -> FloatArray:
        """Rows less what the model's own numbers explain of them."""
        rows = rows * self.mask
        return np.asarray(rows - (rows @ self.tangent.T) @ self.tangent)

    def differences(self, model: Model, trial: list[FloatArray]) -> FloatArray:
        """Simulated differences of a trial from the present model, (columns, n). ``model`` has one form more."""
        base = self.fit.signals
        slots = model.nominal.slots(model.setting)
        own = model.forms[-1]
        start = min(s.at for s in own.slots(model.setting))
        # Signals kept at other sub-steps cannot be gone on from.
        if model.substeps != self.fit.model.substeps or model.continuous != self.fit.model.continuous:
            start = At.DRIVE
        p = self.fit.p.copy()
        for i, slot in enumerate(slots):
            if slot.name in own.pins:
                p[i] = slot.neutral
        rows = [model.simulate(np.concatenate([p, q]), start, base).reading_um - base.reading_um for q in trial]
        return np.array(rows)

    def look(self, index: int, model: Model) -> Screened | None:
        """The best trial of the last form of ``model``, or None where none shows at all."""
        form, setting = model.forms[-1], model.setting
        slots = form.slots(setting)
        neutral = np.array([s.neutral for s in slots])
        best: Screened | None = None
        seen = 0.0
        for trial in form.trials(setting, self.residual):
            rows = self.differences(model, trial)
            if not np.all(np.isfinite(rows)) or float(np.max(np.abs(rows))) > 1e3 * setting.range_um:
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
                best = Screened(index, start, gain, slopes, gram)
        return None if best is None else replace(best, size_um2=seen)


def p_value(looks: list[Screened], gain_um2: float, seed: int, draws: int = 999) -> float:
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


def worse_by(one: HeldOut, other: HeldOut) -> tuple[float, float]:
    """By how much ``one`` errs more than ``other`` (µm²), and that difference in its own standard errors.

    Vuong's comparison of non-nested models, over blocks.
    """
    d = one.per_block_um2 - other.per_block_um2
    spread = float(np.std(d) * np.sqrt(d.size))
    total = float(d.sum())
    return total, total / spread if spread > 0.0 else 0.0
