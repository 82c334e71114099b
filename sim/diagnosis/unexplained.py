"""What a diagnosis leaves: how much of it is explainable at all, and where the rest lies.

A black box is tested on the same folds as the causes. It predicts what the nominal stage leaves. Its columns are the
motion with powers and plays, products of both with the motion, slow lags, the other drives, and what the causes found
explain, behind one lag that is chosen on a grid. Each fold is predicted from the others. What it leaves bounds what a
named cause can claim; it says nothing of a cause.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dehyst.adaptive.types import BoolArray, FloatArray
from dehyst.baselines.prandtl_ishlinskii.operators import play_run
from dehyst.sim.diagnosis.search.held_out import Split
from dehyst.sim.fitting.lags import lag_ends, slow_poles
from dehyst.sim.fitting.parallel import side_by_side
from dehyst.sim.fitting.stage_model import ModelFit

IntArray = NDArray[np.int64]

_RADII = np.array([0.01, 0.025, 0.045, 0.07, 0.1, 0.14, 0.19, 0.25, 0.32, 0.4, 0.5, 0.62, 0.76, 0.9])
_TAUS_S = (0.1, 1.0, 10.0, 100.0)
_LAGS_S = (0.0, 1e-3, 2e-3, 3e-3, 5e-3, 8e-3, 15e-3)
#: Share of the mean squared column that keeps the solution small; the best of these by held-out error counts.
_RIDGES = (1e-8, 1e-6, 1e-4, 1e-2)
#: Most samples of one fit: enough for sixty columns.
_MOST = 40_000


def black_box_error(nominal: ModelFit, extended: ModelFit, mask: BoolArray, parts: Split) -> float:
    """RMS error (µm) of the black box on folds that it was not fitted to.

    ``nominal`` and ``extended`` are two models on one recording; ``mask`` (n,) is False where a sample does not count;
    ``parts`` holds the folds.
    """
    use = _some(mask)
    own = [nominal.residual_um - extended.residual_um, *_of_time(nominal)]
    return min(side_by_side(lambda lag_s: _folded(nominal, own, use, parts, lag_s)[0], _LAGS_S))


def black_box_on_other(
    nominal: ModelFit, there: ModelFit, mask: BoolArray, mask_there: BoolArray, parts: Split
) -> float:
    """RMS error (µm) on another recording of the black box fitted to this one: what this one can teach at most.

    ``there`` is the nominal stage on the other recording; lag and ridge are chosen by the folds of this one.
    """
    use = _some(mask)
    tried = side_by_side(lambda lag_s: (*_folded(nominal, [], use, parts, lag_s), lag_s), _LAGS_S)
    _, ridge, lag_s = min(tried, key=lambda one: one[0])
    columns = np.array([row[use] for row in _columns(nominal, lag_s)])
    scale = _scale(columns)
    columns /= scale
    system = columns @ columns.T + ridge * use.size * np.eye(columns.shape[0])
    weights = np.linalg.solve(system, columns @ nominal.residual_um[use])
    at = np.flatnonzero(mask_there)
    rows = np.array([row[at] for row in _columns(there, lag_s)]) / scale
    left = there.residual_um[at] - weights @ rows
    # A constant belongs to one recording.
    return float(np.std(left))


#: Parts of a record and taps of the finite impulse response that is fitted to each.
_PARTS, _TAPS = 8, 32


def follows_drive(fit: ModelFit, mask: BoolArray) -> float:
    """Share of the squared error of ``fit`` that linear responses to the drives, one for each part of the record,
    explain, less what they explain with the drives reversed in time: about 0 for noise, whatever its colour.

    What is wrong with the timing leaves no response that holds for the whole record, but one for each part.
    """
    data = fit.model.data
    n = data.n // _PARTS
    drives = [u for u in (data.u_V, data.u2_V, data.u3_V) if u is not None]
    shares = np.zeros(2)
    total = 1e-300
    for i in range(_PARTS):
        part = slice(i * n, (i + 1) * n)
        left = np.where(mask, fit.residual_um, 0.0)[part]
        left = left - left.mean()
        total += float(left @ left)
        if not any(np.ptp(u[part]) for u in drives):
            continue
        for way, turn in enumerate((1, -1)):
            rows = []
            for u in drives:
                x = (u[part][::turn] - u[part].mean()) / max(float(np.std(u)), 1e-300)
                rows += [np.concatenate([np.full(k, x[0]), x[: n - k]]) for k in range(min(_TAPS, n // 8))]
            columns = np.array(rows)
            gram = columns @ columns.T
            gram += 1e-6 * np.trace(gram) / len(rows) * np.eye(len(rows))
            weights = np.linalg.solve(gram, columns @ left)
            shares[way] += float(left @ left - np.sum(np.square(left - weights @ columns)))
    return float(shares[0] - shares[1]) / total


def _some(mask: BoolArray) -> IntArray:
    """Indices of at most `_MOST` samples that count."""
    return np.flatnonzero(mask)[:: max(1, int(mask.sum()) // _MOST)]


def _scale(columns: FloatArray) -> FloatArray:
    return np.asarray(np.maximum(np.sqrt(np.mean(np.square(columns), axis=1)), 1e-300)[:, None])


def _folded(
    nominal: ModelFit, more: list[FloatArray], use: IntArray, parts: Split, lag_s: float
) -> tuple[float, float]:
    """RMS error (µm) over the folds behind one lag, and the ridge that it was reached with."""
    fold = np.repeat(parts.fold, np.diff(parts.edges))[use]
    y = nominal.residual_um[use]
    columns = np.array([row[use] for row in (*_columns(nominal, lag_s), *more)])
    columns /= _scale(columns)
    grams, slopes = [], []
    for k in range(parts.n_folds):
        part = columns[:, fold == k]
        grams.append(part @ part.T)
        slopes.append(part @ y[fold == k])
    gram, slope = np.sum(np.array(grams), axis=0), np.sum(np.array(slopes), axis=0)
    tried = []
    for ridge in _RIDGES:
        left = 0.0
        for k in range(parts.n_folds):
            inside = fold == k
            system = gram - grams[k] + ridge * use.size * np.eye(gram.shape[0])
            weights = np.linalg.solve(system, slope - slopes[k])
            left += float(np.sum(np.square(y[inside] - weights @ columns[:, inside])))
        tried.append((float(np.sqrt(left / use.size)), ridge))
    return min(tried)


def _of_time(fit: ModelFit) -> list[FloatArray]:
    """What changes with time alone, (n,) each: it belongs to one recording."""
    t = np.linspace(-1.0, 1.0, fit.model.data.n)
    return [t, t**2, t * (fit.model.data.u_V - fit.model.data.u_low_V) / max(fit.model.data.swing_V, 1e-12)]


def _columns(fit: ModelFit, lag_s: float) -> list[FloatArray]:
    """Columns of the black box behind one lag, (n,) each."""
    data = fit.model.data
    u = data.u_V if lag_s == 0.0 else np.asarray(lag_ends(data.u_V, lag_s / data.dt_s, False))
    u = np.ascontiguousarray(u)
    x = (u - 0.5 * (data.u_low_V + data.u_high_V)) / max(0.5 * data.swing_V, 1e-12)
    plays = list(play_run(u, _RADII * data.swing_V, np.full(_RADII.size, u[0])).T / max(data.swing_V, 1e-12))
    rows = [np.ones(data.n), x, x**2, x**3, *plays, *(x * p for p in plays[::2])]
    # The voltages of samples before: latency, and the rate.
    rows += [np.concatenate([np.full(k, x[0]), x[: data.n - k]]) for k in (1, 2, 4, 8)]
    rows += list(slow_poles(x, data.dt_s / np.array(_TAUS_S)))
    for other in (data.u2_V, data.u3_V):
        if other is not None:
            rows.append((other - other.mean()) / max(float(np.ptp(other)), 1e-12))
    # Dead zones of the displacement, behind the mechanics and before them; speed and acceleration.
    signals = fit.signals
    zero_um = fit.model.nominal.offset_um(fit.model.parameters_of(fit.p, -1))
    moved_um = signals.reading_um - zero_um
    for moved in (moved_um, signals.static_um[:: fit.model.substeps]):
        knees = data.range_um * np.linspace(0.0, 1.0, 8)[1:-1] + min(0.0, data.u_low_V * data.gain_um_per_V)
        rows += [np.maximum(moved - knee, 0.0) for knee in knees]
    speed = np.gradient(moved_um)
    return [*rows, moved_um, speed, np.gradient(speed)]


# --- Where the remaining error of a diagnosed recording lies: in time, frequency, position and direction.


def where_left(fit: ModelFit, mask: BoolArray, sigma_um: float) -> tuple[str, ...]:
    """Sentences that locate the residual of ``fit`` where it stands above the noise ``sigma_um`` (µm)."""
    data, r = fit.model.data, np.where(mask, fit.residual_um, 0.0)
    total = float(np.sum(r**2))
    if total <= 1.2 * sigma_um**2 * float(mask.sum()):
        return ()
    out = []
    block = max(8, round(0.05 / data.dt_s))
    count = data.n // block
    energy = np.sum(r[: count * block].reshape(count, block) ** 2, axis=1)
    order = np.argsort(energy)[::-1]
    half = int(np.searchsorted(np.cumsum(energy[order]), 0.5 * total)) + 1
    if half <= 0.05 * count:
        first = ", ".join(f"{i * block * data.dt_s:.4g} s" for i in sorted(order[: min(half, 4)]))
        out.append(f"time: half of it lies in {100 * half / count:.2g} % of the record, about {first}")
    else:
        out.append("time: it is spread over the record")
    f, power = np.fft.rfftfreq(data.n, data.dt_s), np.abs(np.fft.rfft(r)) ** 2
    share = np.cumsum(power) / max(float(power.sum()), 1e-300)
    low, high = (float(f[int(np.searchsorted(share, q))]) for q in (0.1, 0.9))
    out.append(f"frequency: four fifths of it lie from {low:.3g} to {high:.3g} Hz")
    moving = data.rate_V_per_s > 1e-6 * data.swing_V / data.dt_s
    rising = moving & (np.diff(data.u_V, prepend=data.u_V[0]) > 0.0)
    groups = {"rising": rising & mask, "falling": moving & ~rising & mask, "at rest": ~moving & mask}
    sizes = {k: float(np.sqrt(np.mean(r[m] ** 2))) for k, m in groups.items() if int(m.sum()) > 50}
    out.append("direction: " + ", ".join(f"{1e3 * v:.3g} nm {k}" for k, v in sizes.items()))
    edges = np.linspace(data.u_low_V, data.u_high_V, 5)
    at = np.clip(np.searchsorted(edges, data.u_V) - 1, 0, 3)
    thirds = [
        f"{1e3 * float(np.sqrt(np.mean(r[(at == i) & mask] ** 2))):.3g} nm from {edges[i]:.3g} V"
        for i in range(4)
        if int(((at == i) & mask).sum()) > 50
    ]
    out.append("position: " + ", ".join(thirds))
    return tuple(out)
