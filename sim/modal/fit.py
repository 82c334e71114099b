"""The joint fit of one modal model to the response matrices of several amplitudes, with intervals.

The residues are linear and are eliminated (variable projection); the poles' polynomials are found by
Levenberg-Marquardt on the weighted residual. The poles start from vector fitting at the middle amplitude. Modes that
the Bayesian information criterion does not pay for are taken out, one by one.

Sources: Golub and Pereyra, Inverse Problems 19 (2003) R1 (variable projection, with Kaufman's Jacobian); Pintelon and
Schoukens (2012), chapter 9 (weights from noise and distortion). The intervals are those of the sandwich estimator with
one cluster a line (White, Econometrica 50 (1982) 1), which stays right where the weights or the model are not exact,
and not narrower than those of the weights.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.linalg import solve_triangular

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray, IntArray
from dehyst.sim.modal.model import ModalModel, basis, poles_at, powers_of, stacked, vector_fit
from dehyst.sim.modal.periods import ComplexArray, FrequencyResponse

#: Powers of 1/z beside the modes: the direct term and what the anti-alias filter adds beyond the band.
DIRECT: Final = 4
#: Range of damping ratios of a mode; outside of it a pair is no resonance.
DAMPING: Final = (1e-5, 0.95)
#: Least damping of a pair beyond the excited band, where no line would show a peak.
DAMPING_BEYOND: Final = 0.02
#: Error of an entry as a share of the response's rms, where neither noise nor distortion is known.
ASSUMED_ERROR: Final = 1e-3
#: A residue may be this many times as large as the measured response before it costs as much as one equation's error.
#: It keeps pairs close to each other from cancelling with enormous residues.
LARGEST_SHARE: Final = 10.0
#: Steps of a search that only prepares the next one.
SHORT: Final = 8
#: The search ends where a step lowers the cost by less than this share.
CONVERGED: Final = 1e-4
#: Expected size of the change of a pole over the fitted amplitudes, 1 standard deviation: of log frequency, of log
#: damping and of the log rate of a real pole. It keeps weak modes from wandering, and is wide for those that matter.
EXPECTED_CHANGE: Final = (0.02, 0.3, 0.3)
#: Two-sided 95 % quantile of the normal distribution.
QUANTILE_95: Final = 1.959964


@dataclass(frozen=True, slots=True)
class FitSettings:
    """Settings of the fit.

    ``start_modes``: mode pairs of the vector fit, more than expected. ``degree``: of the polynomials in the amplitude;
    None takes 2, or as many as the
    amplitudes determine. ``most_steps``: of each Levenberg-Marquardt search.
    ``prune``: take out modes that the information criterion does not pay for.
    """

    start_modes: int = 30
    degree: int | None = None
    direct: int = DIRECT
    most_steps: int = 40
    prune: bool = True


@dataclass(frozen=True, slots=True)
class ModalFit:
    """A fitted model with the precision of its poles.

    Attributes
    ----------
    model : the model.
    covariance : of ``model.theta.ravel()``, (n, n) with n = (2N + Q)(degree + 1).
    cost : weighted sum of squared residuals; about ``equations`` where the weights are right.
    equations : number of real equations.
    parameters : number of real parameters, residues included.
    converged : the search ended at a minimum, not at its last step.
    """

    model: ModalModel
    covariance: FloatArray
    cost: float
    equations: int
    parameters: int
    converged: bool

    def interval(self, row: int, amplitude_V: float) -> float:
        """Half width of the 95 % interval of a row of ``theta`` at an amplitude (a logarithm: a relative width)."""
        size = self.model.degree + 1
        direction = powers_of(self.model.position(amplitude_V), self.model.degree)
        part = self.covariance[row * size : (row + 1) * size, row * size : (row + 1) * size]
        return QUANTILE_95 * float(np.sqrt(max(0.0, float(direction @ part @ direction))))


@dataclass(frozen=True, slots=True)
class _Level:
    """One amplitude: points, weighted entries (F, E), weights, and powers of its position."""

    z: ComplexArray
    target: FloatArray
    weight: FloatArray
    powers: FloatArray
    x: float


@dataclass(frozen=True, slots=True)
class _State:
    """A point of the search: poles' polynomials, orthogonal columns, triangle, their scale, residues, residuals."""

    theta: FloatArray
    q: FloatArray
    r: FloatArray
    scale: FloatArray
    coefficients: FloatArray
    left: FloatArray
    cost: float


class _Problem:
    """The weighted residual of all levels as a function of the poles' polynomials."""

    def __init__(self, responses: Sequence[FrequencyResponse], reference_V: float, degree: int, direct: int) -> None:
        self.degree, self.direct = degree, direct
        self.dt_s = responses[0].spectra.dt_s
        self.output_scale, weights = _weights(responses)
        self.levels: list[_Level] = []
        for response, weight in zip(responses, weights, strict=True):
            x = response.spectra.amplitude_V / reference_V - 1.0
            scaled = response.g * self.output_scale[None, :, None]
            target = stacked(weight[:, None] * scaled.reshape(len(scaled), -1))
            self.levels.append(_Level(response.spectra.z, target, weight, powers_of(x, degree), x))
        self.target = np.concatenate([level.target for level in self.levels])
        lines_hz = np.concatenate([response.spectra.freq_hz for response in responses])
        self.band_hz = (float(lines_hz.min()), float(lines_hz.max()))
        #: Weight of the squares of the residues' shares.
        self.ridge = 1.0 / (LARGEST_SHARE * float(np.sqrt(np.mean(np.sum(self.target**2, axis=0)))))
        self.shape = responses[0].g.shape[1:]
        self.span = max(1e-9, max(abs(level.x) for level in self.levels))

    def prior(self, theta: FloatArray, modes: int) -> FloatArray:
        """Weights (as ``theta``) of the squares of the polynomials' coefficients: 1 / expected variance; 0 for x⁰."""
        expected = np.repeat(EXPECTED_CHANGE, [modes, modes, len(theta) - 2 * modes])
        weights = (self.span ** np.arange(theta.shape[1]) / expected[:, None]) ** 2
        weights[:, 0] = 0.0
        return np.asarray(weights, dtype=np.float64)

    def evaluate(self, theta: FloatArray, modes: int) -> _State:
        """Residues by least squares, and the residual."""
        blocks = []
        for level in self.levels:
            pairs, reals = poles_at(theta, modes, level.x, self.dt_s)
            own = stacked(level.weight[:, None] * basis(level.z, pairs, reals, self.direct))
            blocks.append(np.concatenate([power * own for power in level.powers], axis=1))
        columns = np.concatenate(blocks)
        scale = np.linalg.norm(columns, axis=0)
        if not np.all(np.isfinite(scale)):
            return _State(theta, columns, columns, scale, np.zeros((0, 0)), self.target, np.inf)
        count = len(scale)
        whole, r = np.linalg.qr(np.concatenate([columns / scale, self.ridge * np.eye(count)]))
        q = whole[:-count]
        along = q.T @ self.target
        left = self.target - q @ along
        shares = solve_triangular(r, along)
        coefficients = shares / scale[:, None]
        penalty = float(np.sum(self.prior(theta, modes) * theta**2) + np.sum((self.ridge * shares) ** 2))
        return _State(theta, q, r, scale, coefficients, left, float(np.sum(left**2)) + penalty)

    def sensitivities(self, state: _State, modes: int) -> list[FloatArray]:
        """For each level (2F, E, 2N + Q): change of the fitted entries with each row of theta, residues held."""
        count = 2 * modes + (len(state.theta) - 2 * modes)
        found = []
        c = state.coefficients.reshape(self.degree + 1, -1, self.target.shape[1])
        for level in self.levels:
            values = state.theta @ level.powers
            pairs, reals = poles_at(state.theta, modes, level.x, self.dt_s)
            own = np.tensordot(level.powers, c, axes=1)
            residues = own[:modes] + 1j * own[modes : 2 * modes]
            damping = np.exp(values[modes : 2 * modes])
            omega = 2.0 * np.pi * np.exp(values[:modes])
            s = omega * (-damping + 1j * np.sqrt(1.0 - damping**2))
            by_damping = omega * damping * (-1.0 - 1j * damping / np.sqrt(1.0 - damping**2))
            out = np.empty((2 * level.z.size, self.target.shape[1], count))
            upper = 1.0 / (level.z[:, None] - pairs) ** 2
            lower = 1.0 / (level.z[:, None] - pairs.conj()) ** 2
            for i in range(modes):
                for row, ds in ((i, s[i]), (modes + i, by_damping[i])):
                    step = pairs[i] * ds * self.dt_s
                    change = np.outer(upper[:, i], step * residues[i]) + np.outer(
                        lower[:, i], np.conj(step * residues[i])
                    )
                    out[:, :, row] = stacked(level.weight[:, None] * change)
            rates = np.exp(values[2 * modes :])
            for i, rate in enumerate(rates):
                step = -reals[i] * rate * self.dt_s
                change = np.outer(1.0 / (level.z - reals[i]) ** 2, step * own[2 * modes + i])
                out[:, :, 2 * modes + i] = stacked(level.weight[:, None] * change)
            found.append(out)
        return found

    def _along(self, state: _State, changes: list[FloatArray]) -> FloatArray:
        """(columns, E, 2N + Q, degree + 1): the changes of all levels along the orthogonal columns."""
        along = np.zeros((state.q.shape[1], self.target.shape[1], len(state.theta), self.degree + 1))
        start = 0
        for level, change in zip(self.levels, changes, strict=True):
            part = state.q[start : start + len(change)].T @ change.reshape(len(change), -1)
            along += part.reshape(len(along), -1, len(state.theta))[..., None] * level.powers
            start += len(change)
        return along

    def normal_equations(self, state: _State, modes: int) -> tuple[FloatArray, FloatArray]:
        """``JᵀJ`` (n, n) and ``Jᵀ r`` (n,) of the projected residual; parameters in the order of ``theta.ravel()``."""
        rows, size = len(state.theta), self.degree + 1
        squares = np.zeros((rows, size, rows, size))
        gradient = np.zeros((rows, size))
        changes = self.sensitivities(state, modes)
        start = 0
        for level, change in zip(self.levels, changes, strict=True):
            stop = start + len(change)
            flat = change.reshape(-1, rows)
            power = level.powers
            squares += np.einsum("ij,a,b->iajb", flat.T @ flat, power, power)
            gradient += np.outer(flat.T @ state.left[start:stop].ravel(), power)
            start = stop
        flat_along = self._along(state, changes).reshape(-1, rows * size)
        prior = self.prior(state.theta, modes)
        whole = squares.reshape(rows * size, -1) - flat_along.T @ flat_along + np.diag(prior.ravel())
        return whole, (gradient - prior * state.theta).ravel()

    def covariance(self, state: _State, modes: int) -> FloatArray:
        """Sandwich covariance of ``theta.ravel()``, one cluster a line.

        The residual of a line that the residues follow closely is too small; it is divided by one minus the leverage
        (HC3 of MacKinnon and White, Journal of Econometrics 29 (1985) 305).
        """
        rows, size = len(state.theta), self.degree + 1
        squares, _ = self.normal_equations(state, modes)
        changes = self.sensitivities(state, modes)
        along = self._along(state, changes)
        start, scores = 0, []
        for level, change in zip(self.levels, changes, strict=True):
            stop = start + len(change)
            leverage = np.sum(state.q[start:stop] ** 2, axis=1)
            left = state.left[start:stop] / np.maximum(1e-3, 1.0 - leverage)[:, None]
            own = np.einsum("fe,fer->fr", left, change)[:, :, None] * level.powers
            # Σ_e left[f, e] (q along)[f, e, ...] without the large product.
            outer = np.einsum("fc,fe->fce", state.q[start:stop], left).reshape(len(left), -1)
            projected = outer @ along.reshape(-1, rows * size)
            score = own.reshape(len(left), -1) - projected
            half = len(score) // 2
            scores.append(score[:half] + score[half:])
            start = stop
        score = np.concatenate(scores)
        inverse = np.linalg.pinv(squares, hermitian=True)
        sandwich = inverse @ (score.T @ score) @ inverse
        # A narrow mode has few lines, and their scatter is a poor estimate: not below what the weights alone say.
        freedom = self.target.size - state.coefficients.size - rows * size
        by_weights = np.diag(inverse) * state.cost / max(1, freedom)
        raised = np.sqrt(np.maximum(1.0, by_weights / np.maximum(1e-300, np.diag(sandwich))))
        return np.asarray(sandwich * np.outer(raised, raised), dtype=np.float64)


def _weights(responses: Sequence[FrequencyResponse]) -> tuple[FloatArray, list[FloatArray]]:
    """A scale for each output, and a weight for each line: 1 over the standard deviation of a scaled entry.

    One weight for all entries of a line keeps one triangle for all of them. Where no variance is known, or it is 0,
    all lines weigh the same, as with errors of `ASSUMED_ERROR`.
    """
    responses = [_with_distortion(response, responses) for response in responses]
    totals = np.concatenate([response.total for response in responses])
    signal = np.concatenate([np.mean(np.abs(response.g) ** 2, axis=2) for response in responses]).mean(axis=0)
    known = bool(np.isfinite(totals).all() and (totals.mean(axis=0) > 1e-16 * signal).all())
    scale = 1.0 / np.sqrt(totals.mean(axis=0) if known else signal)
    weights = []
    for response in responses:
        if known:
            variance = np.mean(response.total * scale**2, axis=1)
            # Of a complex variance, half is in the real and half in the imaginary part.
            weights.append(np.sqrt(2.0 * response.power / variance))
        else:
            weights.append(np.full(response.power.size, 1.0 / ASSUMED_ERROR))
    return scale, weights


def _with_distortion(response: FrequencyResponse, others: Sequence[FrequencyResponse]) -> FrequencyResponse:
    """With as many realisations as drives nothing shows the distortion: the nearest amplitude's, scaled to this one."""
    if response.knows_distortion:
        return response
    known = [other for other in others if other.knows_distortion]
    if not known:
        return response
    amplitude = response.spectra.amplitude_V
    nearest = min(known, key=lambda other: abs(np.log(other.spectra.amplitude_V / amplitude)))
    ratio = (amplitude / nearest.spectra.amplitude_V) ** 2
    at = response.spectra.freq_hz
    total = np.column_stack([ratio * np.interp(at, nearest.spectra.freq_hz, column) for column in nearest.total.T])
    return replace(response, total=total)


def _search(problem: _Problem, theta: FloatArray, modes: int, most_steps: int) -> tuple[_State, bool]:
    """Levenberg-Marquardt from ``theta``. Returns the last state and whether it is a minimum."""
    state = problem.evaluate(theta, modes)
    damping, quiet = 1e-3, 0
    # A step of more than a tenth in frequency or a factor of e in damping leaves the region of the expansion.
    limit = np.full(len(theta), 1.0)
    limit[:modes] = 0.1
    for _ in range(most_steps):
        squares, gradient = problem.normal_equations(state, modes)
        diagonal = np.maximum(np.diag(squares), 1e-12 * np.diag(squares).max())
        before = state.cost
        for _ in range(10):
            change = np.linalg.solve(squares + damping * np.diag(diagonal), gradient).reshape(theta.shape)
            change *= np.minimum(1.0, limit / np.maximum(1e-300, np.abs(change).max(axis=1)))[:, None]
            new = problem.evaluate(_kept_in_range(problem, state.theta, state.theta + change, modes), modes)
            if new.cost < state.cost:
                state, damping = new, max(1e-9, damping / 5.0)
                break
            damping *= 4.0
        gain = (before - state.cost) / max(before, 1e-300)
        quiet = quiet + 1 if gain < CONVERGED else 0
        if quiet >= 2 or gain == 0.0:
            return state, True
    return state, False


def _kept_in_range(problem: _Problem, old: FloatArray, new: FloatArray, modes: int) -> FloatArray:
    """``new`` with the old rows where a pair would be no oscillation below half the sample rate at some amplitude."""
    kept = new.copy()
    values = new @ np.column_stack([level.powers for level in problem.levels])
    frequency, damping = values[:modes], values[modes : 2 * modes]
    low, high = np.log(DAMPING)
    beyond = (frequency < np.log(problem.band_hz[0])) | (frequency > np.log(problem.band_hz[1]))
    inside = (old[:modes, 0] >= np.log(problem.band_hz[0])) & (old[:modes, 0] <= np.log(problem.band_hz[1]))
    crossing = beyond & inside[:, None]
    bad = (frequency > np.log(0.5 / problem.dt_s)) | (damping > high) | crossing
    bad |= damping < np.where(beyond, np.log(DAMPING_BEYOND), low)
    rows = np.flatnonzero(bad.any(axis=1))
    kept[rows], kept[modes + rows] = old[rows], old[modes + rows]
    return kept


def _prices(problem: _Problem, state: _State, modes: int) -> FloatArray:
    """(N,) rise of the cost if a pair's residues were 0 and all others fitted again, poles held."""
    inverse = solve_triangular(state.r, np.eye(len(state.r)))
    width = state.coefficients.shape[0] // (problem.degree + 1)
    c = state.coefficients * state.scale[:, None]
    rises = np.empty(modes)
    for i in range(modes):
        columns = np.concatenate([[k * width + i, k * width + modes + i] for k in range(problem.degree + 1)])
        rows = inverse[columns]
        rises[i] = float(np.sum(c[columns] * np.linalg.solve(rows @ rows.T, c[columns])))
    return rises


def _start(response: FrequencyResponse, settings: FitSettings) -> tuple[FloatArray, int]:
    """Poles of one amplitude from vector fitting, as a column (2N + Q, 1) of ``theta``, and N."""
    problem = _Problem([response], response.spectra.amplitude_V, 0, settings.direct)
    z = response.spectra.z
    scaled = (response.g * problem.output_scale[None, :, None]).reshape(z.size, -1)
    band = (float(np.angle(z[0])), float(np.angle(z[-1])))
    weight = problem.levels[0].weight
    pairs, reals = vector_fit(z, scaled, weight, pairs=settings.start_modes, direct=settings.direct, band=band)
    # Beyond the excited band one pair on either side is enough for what reaches into it.
    angle = np.angle(pairs)
    below, above = np.flatnonzero(angle < band[0])[:-1], np.flatnonzero(angle > band[1])[1:]
    pairs = np.delete(pairs, np.concatenate([below, above]))
    s = np.log(pairs) / problem.dt_s
    rates = -np.log(reals[(reals > 1e-3) & (reals < 1.0 - 1e-9)]) / problem.dt_s
    frequency = np.minimum(np.abs(s) / (2.0 * np.pi), 0.499 / problem.dt_s)
    beyond = (frequency < problem.band_hz[0]) | (frequency > problem.band_hz[1])
    least = np.where(beyond, DAMPING_BEYOND, DAMPING[0])
    damping = np.clip(-s.real / np.abs(s), 1.01 * least, 0.99 * DAMPING[1])
    return np.log(np.concatenate([frequency, damping, rates]))[:, None], pairs.size


def _pruned(
    problem: _Problem, theta: FloatArray, modes: int, settings: FitSettings, say: Callable[[str], None]
) -> tuple[_State, int, bool]:
    """Search, and take out, weakest first, the pairs that do not pay. Returns the state, N and whether it converged."""
    if not settings.prune:
        state, converged = _search(problem, theta, modes, settings.most_steps)
        return state, modes, converged
    equations = problem.target.size
    price = (2 * problem.target.shape[1] + 2) * (problem.degree + 1) * np.log(equations)
    # A short search suffices to tell what is useless; the full one follows when nothing is left to take out.
    state, converged = _search(problem, theta, modes, SHORT)
    while True:
        before = modes
        while modes > 1:
            rises = _prices(problem, state, modes)
            level = state.cost / (equations - state.coefficients.size)
            weakest = int(np.argmin(rises))
            if rises[weakest] > price * level:
                break
            say(f"take out the pair at {np.exp(state.theta[weakest, 0]):.1f} Hz: it does not pay for its parameters")
            state = problem.evaluate(np.delete(state.theta, [weakest, modes + weakest], axis=0), modes - 1)
            modes -= 1
        if modes == before and converged:
            return state, modes, converged
        steps = settings.most_steps if modes == before else SHORT
        state, converged = _search(problem, state.theta, modes, steps)
        if modes == before and not converged:
            return state, modes, converged


def _across(
    problem: _Problem, responses: Sequence[FrequencyResponse], theta: FloatArray, modes: int, settings: FitSettings
) -> FloatArray:
    """Polynomials from fits of each amplitude alone, each started at the poles of its neighbour nearer to the middle.

    A row whose change is far beyond the expected one starts without a change.
    """
    middle = len(responses) // 2
    columns = {middle: theta}
    for k in [*range(middle + 1, len(responses)), *range(middle - 1, -1, -1)]:
        response = responses[k]
        alone = _Problem([response], response.spectra.amplitude_V, 0, settings.direct)
        state, _ = _search(alone, columns[k - 1 if k > middle else k + 1], modes, SHORT)
        columns[k] = state.theta
    values = np.column_stack([columns[k] for k in range(len(responses))])
    powers = np.vstack([level.powers for level in problem.levels])
    polynomials: FloatArray = np.asarray(np.linalg.lstsq(powers, values.T, rcond=None)[0].T, dtype=np.float64)
    wild = np.sum(problem.prior(polynomials, modes) * polynomials**2, axis=1) > 9.0
    rows = np.flatnonzero(wild | np.concatenate([wild[modes : 2 * modes], wild[:modes], wild[2 * modes :]]))
    polynomials[rows] = 0.0
    polynomials[rows, 0] = theta[rows, 0]
    return np.asarray(_kept_in_range(problem, _constant(theta, problem.degree), polynomials, modes), dtype=np.float64)


def _constant(theta: FloatArray, degree: int) -> FloatArray:
    return np.hstack([theta, np.zeros((len(theta), degree))])


def fit_modes(
    responses: Sequence[FrequencyResponse],
    settings: FitSettings | None = None,
    progress: Callable[[str], None] | None = None,
) -> ModalFit:
    """One modal model for the response matrices of one or several amplitudes.

    Raises InputError where the responses do not belong together, or where the band has too few lines.
    """
    settings = settings or FitSettings()
    say = progress or (lambda _: None)
    _check(responses, settings)
    ordered = sorted(responses, key=lambda response: response.spectra.amplitude_V)
    amplitudes = [response.spectra.amplitude_V for response in ordered]
    degree = settings.degree if settings.degree is not None else min(2, len(ordered) - 1)
    reference_V = float(np.mean(amplitudes))
    problem = _Problem(ordered, reference_V, degree, settings.direct)
    middle = ordered[len(ordered) // 2]
    theta, modes = _start(middle, settings)
    say(f"vector fitting at {middle.spectra.amplitude_V:.4g} V: {modes} pairs, {len(theta) - 2 * modes} real poles")
    alone = _Problem([middle], middle.spectra.amplitude_V, 0, settings.direct)
    state, modes, converged = _pruned(alone, theta, modes, settings, say)
    say(f"{modes} pairs at {middle.spectra.amplitude_V:.4g} V")
    if len(ordered) > 1:
        theta = _across(problem, ordered, state.theta, modes, settings)
        state, modes, converged = _pruned(problem, theta, modes, settings, say)
        say(f"{modes} pairs at all {len(ordered)} amplitudes together")
    else:
        state = problem.evaluate(state.theta, modes)
    equations = int(problem.target.size)
    covariance = problem.covariance(state, modes)
    model = ModalModel(
        dt_s=problem.dt_s,
        reference_V=reference_V,
        low_V=amplitudes[0],
        high_V=amplitudes[-1],
        modes=modes,
        theta=state.theta,
        coefficients=_in_um(problem, state),
        direct=settings.direct,
    )
    size = degree + 1
    fit = ModalFit(model, covariance, state.cost, equations, state.coefficients.size + state.theta.size, converged)
    return _ordered(fit, size)


def _in_um(problem: _Problem, state: _State) -> FloatArray:
    shape = (problem.degree + 1, -1, *problem.shape)
    return np.asarray(state.coefficients.reshape(shape) / problem.output_scale[None, None, :, None], dtype=np.float64)


def _ordered(fit: ModalFit, size: int) -> ModalFit:
    """The same fit with its modes in ascending order of frequency."""
    model = fit.model
    n = model.modes
    order = np.argsort(model.theta[:n, 0])
    rows = np.concatenate([order, n + order, np.arange(2 * n, len(model.theta))])
    basis_rows = np.concatenate([order, n + order, np.arange(2 * n, model.coefficients.shape[1])])
    flat = (rows[:, None] * size + np.arange(size)).ravel()
    sorted_model = replace(model, theta=model.theta[rows], coefficients=model.coefficients[:, basis_rows])
    return replace(fit, model=sorted_model, covariance=fit.covariance[np.ix_(flat, flat)])


def _check(responses: Sequence[FrequencyResponse], settings: FitSettings) -> None:
    if not responses:
        raise InputError("recordings: got none, expected one or more")
    first = responses[0]
    for response in responses[1:]:
        if response.g.shape[1:] != first.g.shape[1:]:
            raise InputError(
                f"{response.spectra.name}: channels: got outputs and drives {response.g.shape[1:]}, expected "
                f"{first.g.shape[1:]} as in {first.spectra.name}"
            )
        if abs(response.spectra.dt_s / first.spectra.dt_s - 1.0) > 1e-6:
            raise InputError(
                f"{response.spectra.name}: sample time: got {response.spectra.dt_s:g} s, expected "
                f"{first.spectra.dt_s:g} s as in {first.spectra.name}: resample it"
            )
    if settings.degree is not None and not 0 <= settings.degree < len(responses):
        raise InputError(
            f"degree: got {settings.degree} with {len(responses)} amplitudes, expected 0 to {len(responses) - 1}"
        )
    fewest = min(response.spectra.lines.size for response in responses)
    if settings.start_modes < 1 or fewest < 4 * settings.start_modes + settings.direct + 4:
        raise InputError(
            f"modes: got {settings.start_modes} to start from with {fewest} excited lines, expected 1 to "
            f"{max(1, (fewest - settings.direct - 4) // 4)}: start from fewer modes, or record longer periods"
        )


def refitted(
    fit: ModalFit, responses: Sequence[FrequencyResponse], held: IntArray, degree: int | None = None
) -> ModalModel:
    """The model with the rows ``held`` of ``theta`` at their mean over the amplitudes, and all residues fitted again.

    ``degree`` 0 makes the residues constant as well: one linear model for all amplitudes (all rows are held then).
    """
    model = fit.model
    ordered = sorted(responses, key=lambda response: response.spectra.amplitude_V)
    powers = np.vstack([powers_of(model.position(r.spectra.amplitude_V), model.degree) for r in ordered])
    theta = model.theta.copy()
    mean = theta[held] @ powers.mean(axis=0)
    theta[held] = 0.0
    theta[held, 0] = mean
    if degree is not None:
        theta = theta[:, : degree + 1]
    problem = _Problem(ordered, model.reference_V, theta.shape[1] - 1, model.direct)
    state = problem.evaluate(theta, model.modes)
    return replace(model, theta=theta, coefficients=_in_um(problem, state))
