"""What has changed in a stage between a stretch in which a model was good and a recent one.

Both stretches are explained together: by columns that act in both (what the frozen model always lacked) and by columns
of possible causes that act in the recent one alone. A cause is named where it clearly improves the prediction of
blocks that were not used for its numbers. The model is frozen, so no learning can hide the change.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.signal import lfilter

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import BoolArray, FloatArray, InverseModel
from dehyst.baselines.prandtl_ishlinskii.operators import play_run, play_start

# --- Two stretches as one regression, cross-validated by blocks: what the frozen model always lacked, and what is new.

#: Length of a block, s, and number of folds: every fifth block is held out in turn.
BLOCK_S, FOLDS = 0.25, 5


@dataclass(frozen=True)
class ChangeRegression:
    """Both stretches as one regression.

    Attributes
    ----------
    r : (n,) applied voltage minus that of the frozen model, V.
    common : (n, k) columns that act in both stretches.
    causes : causes whose columns are zero in the reference.
    block : (n,) index of the block of each sample. recent : (n,) whether it belongs to the recent stretch.
    """

    r: FloatArray
    common: FloatArray
    causes: tuple[ChangeCause, ...]
    block: FloatArray
    recent: BoolArray

    def errors(self, chosen: tuple[int, ...]) -> FloatArray:
        """Held-out errors (n,) with the causes ``chosen``, each block predicted from the other folds."""
        x = np.column_stack([self.common, *(self.causes[i].columns for i in chosen)])
        x = x / np.maximum(np.linalg.norm(x, axis=0), 1e-30)
        out = np.empty_like(self.r)
        for fold in range(FOLDS):
            test = self.block % FOLDS == fold
            beta = _solve(x[~test], self.r[~test])
            out[test] = self.r[test] - x[test] @ beta
        return out

    def by_block(self, errors: FloatArray) -> FloatArray:
        """Sum of squared ``errors`` (n,) in each block."""
        place = np.unique(self.block, return_inverse=True)[1]
        return np.asarray(np.bincount(place, weights=errors**2))

    def fit(self, chosen: tuple[int, ...]) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Coefficients of all columns, their standard errors (by blocks: errors are correlated), the residual."""
        x = np.column_stack([self.common, *(self.causes[i].columns for i in chosen)])
        size = np.maximum(np.linalg.norm(x, axis=0), 1e-30)
        beta = _solve(x / size, self.r)
        left = self.r - (x / size) @ beta
        rows = (x / size) * left[:, None]
        place = np.unique(self.block, return_inverse=True)[1]
        scores = np.zeros((int(place.max()) + 1, x.shape[1]))
        np.add.at(scores, place, rows)
        bread = np.linalg.pinv((x / size).T @ (x / size), rcond=1e-10, hermitian=True)
        cover = bread @ (scores.T @ scores) @ bread
        return beta / size, np.sqrt(np.maximum(np.diag(cover), 0.0)) / size, left


def _solve(x: FloatArray, r: FloatArray) -> FloatArray:
    """Least squares of columns of unit norm, with a slight ridge for columns that the data cannot tell apart."""
    gram = x.T @ x
    return np.asarray(np.linalg.solve(gram + 1e-5 * np.eye(gram.shape[0]), x.T @ r))


class TooFewSamples(InputError):
    """A stretch, named ``stretch``, has too few usable samples."""

    def __init__(self, stretch: str, message: str) -> None:
        super().__init__(message)
        self.stretch = stretch


def require_enough(name: str, n: int, dt_s: float) -> None:
    """Raise TooFewSamples where ``n`` usable samples of the stretch ``name``, ``dt_s`` s apart, are not enough."""
    if n * dt_s < FOLDS * BLOCK_S or n < 200:
        raise TooFewSamples(
            name,
            f"{name}: got {n} usable samples ({n * dt_s:.3g} s) after those that settle the memory, expected "
            f"at least {FOLDS * BLOCK_S:g} s and 200: wait for more, or move further",
        )


def regression_of(
    model: InverseModel, reference: Stretch, recent: Stretch, scales: Scales
) -> tuple[ChangeRegression, FloatArray]:
    """The regression of both stretches, and its common columns (n, k). Raises TooFewSamples."""
    rows, targets, shared, marks, blocks = [], [], [], [], []
    found: list[ChangeCause] = []
    kept = np.empty(0, dtype=np.intp)
    first = 0
    for stretch, is_recent in ((reference, False), (recent, True)):
        base = frozen_answer(model, stretch, scales)
        found = causes_of(model, stretch, scales, base)
        own = [c.columns for c in found]
        keep = stretch.scored & base.certain
        name = "recent" if is_recent else "reference"
        require_enough(name, int(keep.sum()), stretch.dt_s)
        shared.append(np.column_stack([slow(stretch.motion[:, 0], stretch.dt_s, scales), *own])[keep])
        rows.append([c[keep] if is_recent else np.zeros_like(c[keep]) for c in own])
        targets.append((stretch.u_V - base.u_V)[keep])
        marks.append(np.full(int(keep.sum()), is_recent))
        index = first + np.arange(stretch.u_V.size) // max(1, round(BLOCK_S / stretch.dt_s))
        first = int(index[-1]) + 1
        blocks.append(index[keep])
        kept = np.flatnonzero(keep)
    common, r = np.vstack(shared), np.concatenate(targets)
    now = np.concatenate(marks)
    causes = [replace(c, columns=np.vstack([rows[0][i], rows[1][i]])) for i, c in enumerate(found)]
    # A mains line is searched for in the residual of the recent stretch.
    left = np.zeros(recent.u_V.size)
    left[kept] = (r - common @ solve_scaled(common, r))[now]
    line = hum(recent, left)
    if line is not None:
        columns = np.zeros((r.size, 2))
        columns[now] = line.columns[kept]
        causes.append(replace(line, columns=columns))
    return ChangeRegression(r, common, tuple(causes), np.concatenate(blocks), now), common


def solve_scaled(x: FloatArray, r: FloatArray) -> FloatArray:
    """Coefficients (k,) of the least squares of columns (n, k) of any norm on ``r`` (n,)."""
    size = np.maximum(np.linalg.norm(x, axis=0), 1e-30)
    return np.asarray(_solve(x / size, r) / size)


# --- How the causes of a change show in the error of a frozen inverse model.
#
# The frozen model answers the measured motion with the voltage that the unchanged stage would have needed. The applied
# voltage differs from it by what has changed since. Each cause can be undone in the motion (divide by the new gain,
# look ahead by the new lag, ...). Its signature is the model's answer to the undone motion minus its answer to the
# measured one, per unit of the cause. It includes hysteresis and lags and needs no second model.

#: Time constants of the slow poles that represent creep, s.
SLOW_S = (1.0, 10.0)
#: The cause whose column is an offset, which creep and temperature always move a little.
OFFSET = "thermal_drift"
#: Half-widths of the plays that represent the shape of the loop, as shares of the range.
PLAY_SHARES = (0.02, 0.1)
#: The history of the loop has no influence where the answers from two histories differ by less than this share of the
#: range.
CERTAIN_SHARE = 5e-4
#: Mains frequencies to search for, Hz.
MAINS_HZ = (50.0, 60.0)


@dataclass(frozen=True)
class Stretch:
    """Consecutive samples of a stage.

    Attributes
    ----------
    dt_s : sample time, s. t_s, u_V : (n,) times s and voltages V.
    motion : (n, 3) smoothed displacement µm, velocity µm/s, acceleration µm/s².
    scored : (n,) False where a sample was filled in, and at the start, which only settles the memory.
    """

    dt_s: float
    t_s: FloatArray
    u_V: FloatArray
    motion: FloatArray
    scored: BoolArray


@dataclass(frozen=True)
class Scales:
    """Units of size: range and middle of the displacement µm, slope V/µm, displacement at 0 V µm."""

    range_um: float
    middle_um: float
    slope_V_per_um: float
    rest_um: float

    @staticmethod
    def of(stretch: Stretch) -> Scales:
        """The scales of a stretch."""
        y, u = stretch.motion[:, 0], stretch.u_V
        low, high = np.quantile(y, [0.001, 0.999])
        d = y - y.mean()
        slope = float(d @ u / max(float(d @ d), 1e-30))
        rest = float(y.mean() - u.mean() / slope) if slope else float(y.mean())
        return Scales(float(high - low), float(0.5 * (high + low)), slope, rest)


@dataclass(frozen=True)
class ChangeCause:
    """A possible cause of a change.

    Attributes
    ----------
    name, alternatives : the cause, and other causes with the same signature.
    numbers : names of its k numbers, with units.
    least : smallest size that counts as a change.
    columns : (n, k) V, its signature for one unit of each number.
    """

    name: str
    alternatives: tuple[str, ...]
    numbers: tuple[str, ...]
    least: float
    columns: FloatArray


def answer(model: InverseModel, motion: FloatArray, memory: FloatArray) -> FloatArray:
    """Voltages (n,) V of the frozen model for ``motion`` (n, 3), starting from ``memory``."""
    y, v, a = (np.ascontiguousarray(motion[:, i]) for i in range(3))
    return model.feedforward(y, v, a, memory).u_V


@dataclass(frozen=True)
class FrozenAnswer:
    """The frozen model over a stretch: memory at its start, voltages (n,) V, and where these are certain (n,)."""

    memory: FloatArray
    u_V: FloatArray
    certain: BoolArray


def frozen_answer(model: InverseModel, stretch: Stretch, scales: Scales) -> FrozenAnswer:
    """The answer of the frozen model to the measured motion.

    The memory at the start of a stretch is unknown. The model therefore answers from two extreme histories. Samples at
    which their difference has not yet been wiped out are not certain, nor are those outside the model's domain.
    """
    y, v, a = (np.ascontiguousarray(stretch.motion[:, i]) for i in range(3))
    ends = []
    for extreme in (float(y.max()), float(y.min())):
        way = np.concatenate([np.linspace(y[0], extreme, 50), np.linspace(extreme, y[0], 50)])
        still = np.zeros(way.size)
        volts = scales.slope_V_per_um * (way - scales.rest_um)
        ends.append(model.track(way, still, still, volts, model.rest_memory(float(way[0]))))
    one, other = (model.feedforward(y, v, a, memory) for memory in ends)
    apart = np.abs(one.u_V - other.u_V)
    certain = (apart < CERTAIN_SHARE * abs(scales.slope_V_per_um) * scales.range_um) & one.inside & np.isfinite(one.u_V)
    return FrozenAnswer(ends[0], one.u_V, np.asarray(certain, dtype=np.bool_))


def causes_of(model: InverseModel, stretch: Stretch, scales: Scales, base: FrozenAnswer) -> list[ChangeCause]:
    """The causes that can be recognised in the error of a frozen model, with their columns over ``stretch``."""
    y, v, a = stretch.motion.T
    half, rest = 0.5 * scales.range_um, scales.rest_um

    def shown(undo: Callable[[float], FloatArray], step: float) -> FloatArray:
        return (answer(model, undo(step), base.memory) - base.u_V)[:, None] / step

    def gain(g: float) -> FloatArray:
        s = 1.0 / (1.0 + g)
        return np.column_stack([rest + s * (y - rest), s * v, s * a])

    def lag(tau: float) -> FloatArray:
        return np.column_stack([y + tau * v, v + tau * a, a])

    def bend(share: float) -> FloatArray:
        x = (y - scales.middle_um) / half
        return np.column_stack([y - share * half * (x * x - 1.0), v * (1.0 - 2.0 * share * x), a])

    dt, span = stretch.dt_s, scales.range_um
    # Differences use a hundredth of the range: large against round-off, small against the loop.
    a_top = max(float(np.quantile(np.abs(a), 0.99)), 1e-12)
    step_s2 = min(1e-3 * span / a_top, (20.0 * dt) ** 2)
    found = [
        ChangeCause("gain_drift", (), ("gain",), 0.002, shown(gain, 0.01)),
        ChangeCause(
            OFFSET,
            ("creep",),
            ("offset_um",),
            0.005 * span,
            shown(lambda o: np.column_stack([y - o, v, a]), 0.01 * span),
        ),
        ChangeCause(
            "sensor_lag", ("amplifier_lag", "delay"), ("tau_s",), max(2e-5, 0.05 * dt), shown(lag, min(0.2 * dt, 2e-4))
        ),
        ChangeCause(
            "payload_change",
            ("resonance",),
            ("inverse_square_frequency_s2",),
            5e-9,
            shown(lambda k: np.column_stack([y + k * a, v, a]), step_s2),
        ),
        ChangeCause("sensor_nonlinearity", ("asymmetry",), ("bend",), 0.001, shown(bend, 0.005)),
        ChangeCause(
            "hysteresis_shape",
            ("rate_dependence", "asymmetry"),
            tuple(f"play_{100 * s:g}_pct" for s in PLAY_SHARES),
            0.002,
            loops(y, scales),
        ),
    ]
    return found


def loops(y_um: FloatArray, scales: Scales) -> FloatArray:
    """(n, 2) V: the part of a loop that lags the displacement by a play, for each width."""
    r = np.array(PLAY_SHARES) * scales.range_um
    plays = play_run(np.ascontiguousarray(y_um), r, play_start(float(y_um[0]), r, float(y_um[0])))
    return np.asarray(scales.slope_V_per_um * (y_um[:, None] - plays))


def slow(y_um: FloatArray, dt_s: float, scales: Scales) -> FloatArray:
    """(n, 2) V: the displacement through slow poles, which represent the creep that a frozen model lacks."""
    rows = []
    for tau in SLOW_S:
        k = dt_s / (tau + dt_s)
        start = np.array([(1.0 - k) * (y_um[0] - scales.rest_um)])
        filtered, _ = lfilter([k], [1.0, k - 1.0], y_um - scales.rest_um, zi=start)
        rows.append(scales.slope_V_per_um * filtered)
    return np.column_stack(rows)


def hum(stretch: Stretch, left_V: FloatArray) -> ChangeCause | None:
    """A mains line in the residual ``left_V`` (n,), as a cause; None where the sample rate is too low for one."""
    t = stretch.t_s - stretch.t_s[0]
    window = np.hanning(t.size) * stretch.scored
    best, peak = 0.0, -1.0
    for mains in MAINS_HZ:
        if mains * stretch.dt_s > 0.45:
            continue
        for f in mains + np.arange(-0.5, 0.501, 0.25 / max(t[-1], 1.0)):
            power = abs(np.sum(window * left_V * np.exp(-2j * np.pi * f * t)))
            if power > peak:
                best, peak = float(f), float(power)
    if best == 0.0:
        return None
    phase = 2.0 * np.pi * best * t
    return ChangeCause("mains_hum", (), ("sine_V", "cosine_V"), 0.0, np.column_stack([np.sin(phase), np.cos(phase)]))


# --- Comparison.

SCHEMA = 1


@dataclass(frozen=True)
class FoundChange:
    """A cause with its numbers, their 95 % intervals, and the share of the held-out squared error that it removes."""

    name: str
    alternatives: tuple[str, ...]
    numbers: dict[str, float]
    intervals: dict[str, tuple[float, float]]
    heldout_gain: float
    text: str


@dataclass(frozen=True)
class Comparison:
    """Result of a comparison.

    Attributes
    ----------
    verdict : ``unchanged``; ``changed``; or ``unexplained``, where the error grew and no known cause explains it.
    changes : the causes, the most important one first.
    before_um, recent_um, left_um : rms error of the frozen model as displacement, µm, in the reference, in the recent
        stretch, and there after the causes.
    text : the result in words.
    """

    verdict: str
    changes: tuple[FoundChange, ...]
    before_um: float
    recent_um: float
    left_um: float
    text: str

    def as_dict(self) -> dict[str, Any]:
        """JSON form."""
        return {
            "schema": SCHEMA,
            "verdict": self.verdict,
            "text": self.text,
            "error_before_um": self.before_um,
            "error_recent_um": self.recent_um,
            "error_explained_um": self.left_um,
            "effects": [
                {
                    "name": c.name,
                    "alternatives": list(c.alternatives),
                    "parameters": c.numbers,
                    "intervals": {name: list(span) for name, span in c.intervals.items()},
                    "heldout_gain": c.heldout_gain,
                    "text": c.text,
                }
                for c in self.changes
            ],
        }


def phrase(name: str, values: FloatArray, scales: Scales) -> str:
    """A cause and its size in words."""
    first = float(values[0])
    match name:
        case "gain_drift":
            return f"gain drift, {100.0 * first:+.1f} %"
        case "thermal_drift":
            return f"thermal drift or another offset, {first:+.3g} µm"
        case "sensor_lag":
            return f"lag, {1e3 * first:+.3g} ms"
        case "payload_change":
            return f"payload on the stage, {first:+.2g} s² of 1/ω²"
        case "sensor_nonlinearity":
            return f"bend of the characteristic, {100.0 * first:+.2g} % of half the range"
        case "hysteresis_shape":
            return f"shape of the loop, {100.0 * float(np.sum(values)):+.2g} % of the motion"
        case "mains_hum":
            return f"mains hum, {float(np.hypot(*values)) / abs(scales.slope_V_per_um) * 1e3:.3g} nm"
    return name


#: Least share of the held-out squared error that a cause must remove, and by how many standard errors.
LEAST_GAIN, LEAST_SIGMAS = 0.1, 3.0
#: A cause that does as well within this share of the gain, or within so many standard errors, is an alternative.
CLOSE_SHARE, CLOSE_SIGMAS = 0.05, 2.0
#: The rms error has grown where it exceeds this multiple of the former, and by more than this share of the range.
GROWN, GROWN_SHARE = 1.3, 5e-4
MOST_CAUSES = 3


def compare(model: InverseModel, reference: Stretch, recent: Stretch) -> Comparison:
    """What has changed from ``reference`` to ``recent``, measured with the frozen ``model``.

    Raises TooFewSamples where a stretch is too short, InputError where the stage does not move in the reference.
    """
    for name, stretch in (("reference", reference), ("recent", recent)):
        require_enough(name, int(stretch.scored.sum()), stretch.dt_s)
    scales = Scales.of(reference)
    if not (np.isfinite(scales.slope_V_per_um) and scales.slope_V_per_um != 0.0 and scales.range_um > 0.0):
        raise InputError("reference: got a stretch without motion, expected a moving stage: move it")
    problem, common = regression_of(model, reference, recent, scales)
    chosen, gains = _search(problem)
    after = problem.errors(chosen)
    now = problem.recent
    # Errors before and now, without the common part as the reference alone determines it.
    first = solve_scaled(common[~now], problem.r[~now])
    flat = (problem.r - common @ first) / scales.slope_V_per_um
    before_um, recent_um = _rms(flat[~now]), _rms(flat[now])
    left_um = _rms(after[now]) / abs(scales.slope_V_per_um)
    changes = _named(problem, chosen, gains, scales)
    grown = recent_um > GROWN * before_um and recent_um - before_um > GROWN_SHARE * scales.range_um
    more = left_um > GROWN * before_um and left_um - before_um > max(GROWN_SHARE * scales.range_um, 0.1 * recent_um)
    if not grown:
        # Without a larger error, causes with small numbers only compensate one another.
        verdict, text, changes = "unchanged", "nothing has changed that this motion shows", ()
    elif changes:
        verdict, text = "changed", f"the model's error grew: {'; '.join(c.text for c in changes)}"
        text += "; and something that no known cause explains" if more else ""
    elif more:
        verdict, text = "unexplained", "the model's error grew, and no known cause explains it"
    else:
        verdict, text = "unchanged", "only an offset has changed, by too little to name it"
    return Comparison(verdict, changes, before_um, recent_um, left_um, text)


def _search(problem: ChangeRegression) -> tuple[tuple[int, ...], dict[int, float]]:
    """Choose causes one by one, the one that removes most first. Returns them, and the share that each removes.

    An offset is included from the start, because creep and temperature always move it a little. Whether it counts as a
    change is decided at the end; the shares have an entry only for causes that do.
    """
    offset = next(i for i, c in enumerate(problem.causes) if c.name == OFFSET)
    chosen: tuple[int, ...] = (offset,)
    gains: dict[int, float] = {}
    now = problem.errors(chosen)
    while len(gains) < MOST_CAUSES:
        best: tuple[float, int, FloatArray] | None = None
        for i in range(len(problem.causes)):
            if i in chosen or not _large(problem, (*chosen, i)):
                continue
            errors = problem.errors((*chosen, i))
            share, sigmas = _improvement(problem, now, errors)
            if share > LEAST_GAIN and sigmas > LEAST_SIGMAS and (best is None or share > best[0]):
                best = share, i, errors
        if best is None:
            break
        gains[best[1]] = best[0]
        chosen, now = (*chosen, best[1]), best[2]
    share, sigmas = _improvement(problem, problem.errors(chosen[1:]), now)
    if share > LEAST_GAIN and sigmas > LEAST_SIGMAS and _large(problem, (*chosen[1:], offset)):
        gains[offset] = share
    return (chosen, gains) if gains else _alone(problem, chosen)


def _alone(problem: ChangeRegression, otherwise: tuple[int, ...]) -> tuple[tuple[int, ...], dict[int, float]]:
    """The single cause that explains most without an offset, for motion too short or narrow to separate the two."""
    none = problem.errors(())
    best: tuple[float, int] | None = None
    for i in range(len(problem.causes)):
        share, sigmas = _improvement(problem, none, problem.errors((i,)))
        good = share > LEAST_GAIN and sigmas > LEAST_SIGMAS and _large(problem, (i,))
        if good and (best is None or share > best[0]):
            best = share, i
    return ((best[1],), {best[1]: best[0]}) if best is not None else (otherwise, {})


def _improvement(problem: ChangeRegression, before: FloatArray, after: FloatArray) -> tuple[float, float]:
    """Removed share of the held-out squared error, and by how many standard errors."""
    base = problem.by_block(before)
    won = base - problem.by_block(after)
    share = float(won.sum() / max(float(base.sum()), 1e-30))
    return share, float(won.sum() / max(float(np.std(won)) * np.sqrt(won.size), 1e-30))


def _large(problem: ChangeRegression, chosen: tuple[int, ...]) -> bool:
    """Whether a number of the last of ``chosen`` exceeds the least size that counts as a change."""
    cause = problem.causes[chosen[-1]]
    beta, _, _ = problem.fit(chosen)
    return bool(np.max(np.abs(beta[-len(cause.numbers) :])) > cause.least)


def _rivals(problem: ChangeRegression, chosen: tuple[int, ...], place: int) -> tuple[str, ...]:
    """Causes that do as well as ``chosen[place]`` within the accuracy of these blocks."""
    rest = chosen[:place] + chosen[place + 1 :]
    mine, less = problem.by_block(problem.errors(chosen)), problem.by_block(problem.errors(rest))
    gain = float(less.sum() - mine.sum())
    names = []
    for i, cause in enumerate(problem.causes):
        if i in chosen:
            continue
        lost = problem.by_block(problem.errors((*rest, i))) - mine
        sigmas = float(lost.sum() / max(float(np.std(lost)) * np.sqrt(lost.size), 1e-30))
        if lost.sum() < CLOSE_SHARE * gain or (sigmas < CLOSE_SIGMAS and lost.sum() < 0.25 * gain):
            names.append(cause.name)
    return tuple(names)


def _named(
    problem: ChangeRegression, chosen: tuple[int, ...], gains: dict[int, float], scales: Scales
) -> tuple[FoundChange, ...]:
    beta, sigma, _ = problem.fit(chosen)
    at = problem.common.shape[1]
    out = []
    for place, i in enumerate(chosen):
        cause = problem.causes[i]
        k = len(cause.numbers)
        values, spans = beta[at : at + k], 1.96 * sigma[at : at + k]
        at += k
        if i not in gains:
            continue
        numbers = {name: float(v) for name, v in zip(cause.numbers, values, strict=True)}
        intervals = {n: (float(v - s), float(v + s)) for n, v, s in zip(cause.numbers, values, spans, strict=True)}
        others = tuple(dict.fromkeys((*cause.alternatives, *_rivals(problem, chosen, place))))
        text = phrase(cause.name, values, scales)
        if others:
            text += f" (or {', '.join(others)})"
        out.append(FoundChange(cause.name, others, numbers, intervals, gains[i], text))
    return tuple(sorted(out, key=lambda c: -c.heldout_gain))


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if values.size else float("nan")
