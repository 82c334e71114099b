"""Held-out error of a calibrated model, by folds of one recording or on another recording, and the monitor's error."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dehyst.adaptive.types import BoolArray, FloatArray
from dehyst.sim.fitting.fit_data import FitData
from dehyst.sim.fitting.stage_model import INITIAL_STATE, ModelFit
from dehyst.sim.readings.noise import monitor_noise_V

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


def split(data: FitData, block_s: float = 0.5, n_folds: int = 4) -> Split:
    """Blocks, and folds that each leave out whole stretches of one waveform and rate.

    Neighbouring blocks with a similar drive (rate within a factor of two, similar share of rest) form one stretch, of
    at most an eighth of the record. Stretches are assigned to the folds in turn.
    """
    block = max(8, min(round(block_s / data.dt_s), data.n // 40))
    count = max(1, data.n // block)
    edges = np.append(np.arange(count) * block, data.n).astype(np.int64)
    rate = np.maximum.reduceat(data.rate_V_per_s, edges[:-1]) + 1e-3 * data.swing_V
    mean = np.add.reduceat(data.rate_V_per_s, edges[:-1]) / np.diff(edges) + 1e-3 * data.swing_V
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
    """Squared error (µm²) of a calibrated model on data that were not used to fit it, per block and in total."""

    per_block_um2: FloatArray
    sse_um2: float


def unit_columns(fit: ModelFit, mask: BoolArray, past: bool = True) -> FloatArray:
    """(m, n) Jacobian columns, one per row, of the parameters away from their bounds, masked and of unit norm."""
    if fit.rows is not None:
        if not past:
            names = [fit.model.parameters[i].name for i in fit.row_indices]
            fit = replace(fit, rows=fit.rows[[i for i, name in enumerate(names) if name not in INITIAL_STATE]])
        assert fit.rows is not None
        norms = np.sqrt(np.einsum("ij,ij->i", fit.rows, fit.rows))
        good = norms > 0.0
        return np.asarray(fit.rows[good] / norms[good, None])
    parameters = fit.model.parameters
    slope_free = [i for i in fit.free if parameters[i].low < fit.p[i] < parameters[i].high]
    if not past:
        slope_free = [i for i in slope_free if parameters[i].name not in INITIAL_STATE]
    rows = fit.model.jacobian(fit.p, fit.signals, slope_free) * mask
    norms = np.sqrt(np.einsum("ij,ij->i", rows, rows))
    good = norms > 1e-9 * max(float(norms.max(initial=0.0)), 1e-300)
    return np.asarray(rows[good] / norms[good, None])


#: A parameter of whose effect a fold holds more than this share keeps its value when the fold is left out: the rest of
#: the recording says nothing about it.
_OWN_SHARE = 0.99


def held_out(fit: ModelFit, mask: BoolArray, parts: Split) -> HeldOut:
    """Leave-one-fold-out error of the model linearised at its calibration; exact for a linear model."""
    rows = unit_columns(fit, mask, past=False)
    residual = fit.residual_um * mask
    per_block = parts.blocks(np.square(residual))
    grams, slopes = [], []
    for f in range(parts.n_folds):
        inside = parts.samples(f)
        part = rows[:, inside]
        grams.append(part @ part.T)
        slopes.append(part @ residual[inside])
    whole, slope = sum(grams), sum(slopes)
    # The ridge keeps directions that only one stretch determines (such as the first rise from rest) at the value from
    # the whole record.
    ridge = 1e-4 * np.eye(rows.shape[0])
    # A calibration stops slightly before its optimum. The remaining step is the same with and without the fold, so it
    # is subtracted.
    short = np.linalg.lstsq(whole + 1e-9 * np.eye(rows.shape[0]), slope, rcond=1e-12)[0]
    out = np.zeros_like(per_block)
    for f in range(parts.n_folds):
        pull = slopes[f] - grams[f] @ short
        free = np.flatnonzero(np.diag(grams[f]) <= _OWN_SHARE)
        move = np.linalg.lstsq((whole - grams[f] + ridge)[np.ix_(free, free)], -pull[free], rcond=1e-12)[0]
        inside = parts.samples(f)
        left = np.zeros_like(residual)
        left[inside] = residual[inside] - move @ rows[np.ix_(free, inside)]
        out += parts.blocks(np.square(left))
    return HeldOut(out, float(out.sum()))


def worse_by(one: HeldOut, other: HeldOut) -> tuple[float, float]:
    """By how much the error of ``one`` exceeds that of ``other`` (µm²), and the same in standard errors.

    Vuong's comparison of non-nested models, over blocks.
    """
    d = one.per_block_um2 - other.per_block_um2
    spread = float(np.std(d) * np.sqrt(d.size))
    total = float(d.sum())
    return total, total / spread if spread > 0.0 else 0.0


def monitor_misfit(fit: ModelFit, mask: BoolArray) -> float:
    """Squared error of the monitor, in units of its noise; gain, offset and latch of the monitor are free.

    Zero without a monitor. Some amplifiers' monitors lag a sample: the better of the two alignments counts.
    """
    data = fit.model.data
    if data.monitor_V is None:
        return 0.0
    seen = data.monitor_V
    best = np.inf
    for drive in (fit.drive_at_samples(), np.roll(fit.drive_at_samples(), -1)):
        x, y = drive[mask], seen[mask]
        columns = np.stack([x, np.ones_like(x)])
        solved = np.linalg.lstsq(columns.T, y, rcond=None)[0]
        best = min(best, float(np.sum(np.square(y - solved @ columns))))
    return best / monitor_noise_V(data) ** 2
