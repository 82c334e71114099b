"""The joint fit of one modal model to the response matrices of several amplitudes, with intervals.

The residues are linear and are eliminated (variable projection); the poles' polynomials are found by
Levenberg-Marquardt on the weighted residual. The poles start from vector fitting at the middle amplitude. Modes that
the Bayesian information criterion does not pay for are taken out, one by one.

Sources: Golub and Pereyra, Inverse Problems 19 (2003) R1 (variable projection, with Kaufman's Jacobian); Pintelon and
Schoukens (2012), chapter 9 (weights from noise and distortion). The intervals are those of the sandwich estimator with
one cluster a line (White, Econometrica 50 (1982) 1), which stays right where the weights or the model are not exact.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.linalg import solve_triangular

from adaptive.errors import InputError
from adaptive.types import FloatArray
from sim.modal.model import ModalModel, poles_at, powers_of
from sim.modal.periods import ComplexArray
from sim.modal.poles import basis, stacked, vector_fit
from sim.modal.response import FrequencyResponse

#: Powers of 1/z beside the modes: the direct term and what the anti-alias filter adds beyond the band.
DIRECT: Final = 4
#: Range of damping ratios of a mode; outside of it a pair is no resonance.
DAMPING: Final = (1e-5, 0.95)
#: The search ends where a step lowers the cost by less than this share.
CONVERGED: Final = 1e-7
#: Two-sided 95 % quantile of the normal distribution.
QUANTILE_95: Final = 1.959964


@dataclass(frozen=True, slots=True)
class FitSettings:
    """Settings of the fit.

    ``start_modes``: mode pairs of the vector fit, more than expected. ``degree``: of the polynomials in the amplitude;
    None takes 1, or 0 for a single amplitude. ``most_steps``: of each Levenberg-Marquardt search.
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
        return self._half_width(row, powers_of(self.model.position(amplitude_V), self.model.degree))

    def interval_of_change(self, row: int, low_V: float, high_V: float) -> float:
        """Half width of the 95 % interval of the change of a row of ``theta`` between two amplitudes."""
        degree = self.model.degree
        change = powers_of(self.model.position(high_V), degree) - powers_of(self.model.position(low_V), degree)
        return self._half_width(row, change)

    def _half_width(self, row: int, direction: FloatArray) -> float:
        size = self.model.degree + 1
        part = self.covariance[row * size : (row + 1) * size, row * size : (row + 1) * size]
        return float(QUANTILE_95 * np.sqrt(max(0.0, direction @ part @ direction)))


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
        self.shape = responses[0].g.shape[1:]

    def evaluate(self, theta: FloatArray, modes: int) -> _State:
        """Residues by least squares, and the residual."""
        blocks = []
        for level in self.levels:
            pairs, reals = poles_at(theta, modes, level.x, self.dt_s)
            own = stacked(level.weight[:, None] * basis(level.z, pairs, reals, self.direct))
            blocks.append(np.concatenate([power * own for power in level.powers], axis=1))
        columns = np.concatenate(blocks)
        scale = np.linalg.norm(columns, axis=0)
        q, r = np.linalg.qr(columns / scale)
        diagonal = np.abs(np.diag(r))
        if not diagonal.min() > 1e-13 * diagonal.max():
            return _State(theta, q, r, scale, np.zeros((0, 0)), self.target, np.inf)
        along = q.T @ self.target
        left = self.target - q @ along
        coefficients = solve_triangular(r, along) / scale[:, None]
        return _State(theta, q, r, scale, coefficients, left, float(np.sum(left**2)))

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

    def normal_equations(self, state: _State, modes: int) -> tuple[FloatArray, FloatArray]:
        """``JᵀJ`` (n, n) and ``Jᵀ r`` (n,) of the projected residual; parameters in the order of ``theta.ravel()``."""
        rows, size = len(state.theta), self.degree + 1
        squares = np.zeros((rows, size, rows, size))
        gradient = np.zeros((rows, size))
        entries = self.target.shape[1]
        along = np.zeros((state.q.shape[1], entries, rows, size))
        start = 0
        for level, change in zip(self.levels, self.sensitivities(state, modes), strict=True):
            stop = start + len(change)
            flat = change.reshape(-1, rows)
            power = level.powers
            squares += np.einsum("ij,a,b->iajb", flat.T @ flat, power, power)
            gradient += np.outer(flat.T @ state.left[start:stop].ravel(), power)
            part = (state.q[start:stop].T @ change.reshape(len(change), -1)).reshape(-1, entries, rows)
            along += part[..., None] * power
            start = stop
        flat_along = along.reshape(-1, rows * size)
        return squares.reshape(rows * size, -1) - flat_along.T @ flat_along, gradient.ravel()

    def covariance(self, state: _State, modes: int) -> FloatArray:
        """Sandwich covariance of ``theta.ravel()``, one cluster a line."""
        rows, size = len(state.theta), self.degree + 1
        squares, _ = self.normal_equations(state, modes)
        changes = self.sensitivities(state, modes)
        entries = self.target.shape[1]
        along = np.zeros((state.q.shape[1], entries, rows, size))
        start = 0
        for level, change in zip(self.levels, changes, strict=True):
            part = state.q[start : start + len(change)].T @ change.reshape(len(change), -1)
            along += part.reshape(-1, entries, rows)[..., None] * level.powers
            start += len(change)
        start, scores = 0, []
        for level, change in zip(self.levels, changes, strict=True):
            stop = start + len(change)
            left = state.left[start:stop]
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
        used = state.q.shape[1] + rows * size / entries
        freedom = self.target.shape[0] / max(1.0, self.target.shape[0] - used)
        return np.asarray(inverse @ (score.T @ score) @ inverse * freedom, dtype=np.float64)


def _weights(responses: Sequence[FrequencyResponse]) -> tuple[FloatArray, list[FloatArray]]:
    """A scale for each output, and a weight for each line: 1 over the standard deviation of a scaled entry.

    One weight for all entries of a line keeps one triangle for all of them. Where no variance is known, or it is 0,
    all lines weigh the same.
    """
    totals = np.concatenate([response.total for response in responses])
    signal = np.concatenate([np.mean(np.abs(response.g) ** 2, axis=2) for response in responses]).mean(axis=0)
    known = bool(np.isfinite(totals).all() and (totals.mean(axis=0) > 1e-16 * signal).all())
    scale = 1.0 / np.sqrt(totals.mean(axis=0) if known else signal)
    weights = []
    for response in responses:
        if known:
            variance = np.mean(response.total * scale**2, axis=1)
            weights.append(np.sqrt(response.power / variance))
        else:
            weights.append(np.ones(response.power.size))
    return scale, weights


def _search(
    problem: _Problem, theta: FloatArray, modes: int, most_steps: int, say: Callable[[str], None]
) -> tuple[_State, bool]:
    """Levenberg-Marquardt from ``theta``. Returns the last state and whether it is a minimum."""
    state = problem.evaluate(theta, modes)
    damping, quiet = 1e-3, 0
    low, high = np.log(DAMPING)
    for step in range(most_steps):
        squares, gradient = problem.normal_equations(state, modes)
        diagonal = np.maximum(np.diag(squares), 1e-12 * np.diag(squares).max())
        before = state.cost
        for _ in range(8):
            change = np.linalg.solve(squares + damping * np.diag(diagonal), gradient).reshape(theta.shape)
            # A step of more than a tenth in frequency or a factor of e in damping leaves the region of the expansion.
            limit = np.full(len(theta), 1.0)
            limit[:modes] = 0.1
            shrink = min(1.0, 1.0 / max(1e-300, float(np.max(np.abs(change).max(axis=1) / limit))))
            tried = state.theta + shrink * change
            tried[modes : 2 * modes, 0] = np.clip(tried[modes : 2 * modes, 0], low, high)
            if _in_range(problem, tried, modes):
                new = problem.evaluate(tried, modes)
                if new.cost < state.cost:
                    state, damping = new, max(1e-9, damping / 5.0)
                    break
            damping *= 4.0
        gain = (before - state.cost) / max(before, 1e-300)
        say(f"step {step + 1}: cost {state.cost:.6g}")
        quiet = quiet + 1 if gain < CONVERGED else 0
        if quiet >= 2 or gain == 0.0:
            return state, True
    return state, False


def _in_range(problem: _Problem, theta: FloatArray, modes: int) -> bool:
    """The dampings of all levels are those of oscillations, and the frequencies are below half the sample rate."""
    nyquist_hz = 0.5 / problem.dt_s
    for level in problem.levels:
        values = theta @ level.powers
        if values[:modes].size and values[:modes].max() > np.log(nyquist_hz):
            return False
        damping = values[modes : 2 * modes]
        if damping.size and (damping.max() > np.log(0.98) or damping.min() < np.log(1e-7)):
            return False
    return True


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


def _without(theta: FloatArray, modes: int, dropped: int) -> FloatArray:
    return np.delete(theta, [dropped, modes + dropped], axis=0)


def _start(response: FrequencyResponse, problem: _Problem, index: int, settings: FitSettings) -> tuple[FloatArray, int]:
    """Poles' polynomials, constant in the amplitude, from vector fitting at one level."""
    level = problem.levels[index]
    z = response.spectra.z
    scaled = (response.g * problem.output_scale[None, :, None]).reshape(z.size, -1)
    band = (float(np.angle(z[0])), float(np.angle(z[-1])))
    pairs, reals = vector_fit(z, scaled, level.weight, pairs=settings.start_modes, direct=settings.direct, band=band)
    s = np.log(pairs) / problem.dt_s
    damping = np.clip(-s.real / np.abs(s), *DAMPING)
    rates = -np.log(reals[(reals > 1e-3) & (reals < 1.0 - 1e-9)]) / problem.dt_s
    theta = np.zeros((2 * pairs.size + rates.size, problem.degree + 1))
    theta[:, 0] = np.log(np.concatenate([np.abs(s) / (2.0 * np.pi), damping, rates]))
    theta[: pairs.size, 0] = np.minimum(theta[: pairs.size, 0], np.log(0.499 / problem.dt_s))
    return theta, pairs.size


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
    degree = settings.degree if settings.degree is not None else min(1, len(ordered) - 1)
    reference_V = float(np.mean(amplitudes))
    problem = _Problem(ordered, reference_V, degree, settings.direct)
    middle = len(ordered) // 2
    theta, modes = _start(ordered[middle], problem, middle, settings)
    say(f"vector fitting: {modes} pairs, {len(theta) - 2 * modes} real poles")
    equations = int(problem.target.size)
    price = (2 * problem.target.shape[1] + 2) * (degree + 1) * np.log(equations)
    state, converged = _search(problem, theta, modes, settings.most_steps if not settings.prune else 6, say)
    while settings.prune and modes > 1:
        rises = _prices(problem, state, modes)
        level = max(1.0, state.cost / (equations - state.coefficients.size))
        weakest = int(np.argmin(rises))
        if rises[weakest] > price * level:
            if converged:
                break
            state, converged = _search(problem, state.theta, modes, settings.most_steps, say)
            continue
        while modes > 1 and rises[weakest] <= price * level:
            hz = float(np.exp(state.theta[weakest, 0]))
            say(f"take out the pair at {hz:.1f} Hz: pays {rises[weakest] / level:.0f} of {price:.0f}")
            state = problem.evaluate(_without(state.theta, modes, weakest), modes - 1)
            modes -= 1
            rises = _prices(problem, state, modes)
            weakest = int(np.argmin(rises))
        state, converged = _search(problem, state.theta, modes, 6, say)
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
    if not 1 <= settings.start_modes or fewest < 4 * settings.start_modes + settings.direct + 4:
        raise InputError(
            f"modes: got {settings.start_modes} to start from with {fewest} excited lines, expected 1 to "
            f"{max(1, (fewest - settings.direct - 4) // 4)}: start from fewer modes, or record longer periods"
        )
