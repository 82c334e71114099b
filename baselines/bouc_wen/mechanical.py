"""Bouc-Wen oscillator driven by a force, with the hysteresis in its restoring force.

    m y'' + c y' + k y + z = u
    z' = alpha y' - beta (gamma |y'| |z|^(nu-1) z + delta y' |z|^nu)

In (2.2) the voltage drives the hysteresis and the stage follows. Here z depends on the motion that it brakes: there is
no closed form, and the model is integrated numerically. Of beta, gamma, delta only two products can be identified.
With the force written as ``z = alpha s w`` for a displacement scale s, the rest is dimensionless::

    s w' = y' - (g |y'| |w|^(nu-1) w + d y' |w|^nu)

**Integration.** Classical Runge-Kutta with ``oversample`` steps per sample. The input between samples is band-limited:
a periodic record is interpolated by its Fourier series, exactly. Reference: J. P. Noël, M. Schoukens, "Hysteretic
benchmark with a dynamic nonlinearity", 2016, whose records are periodic.

**Identification.** The mean and the scatter of whole periods are taken first. Then the steady-state response to the
periodic input is fitted by least squares over all seven parameters, from several starts whose linear part is the best
linear approximation.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from dehyst.adaptive.compiled import compiled
from dehyst.adaptive.errors import InputError, NumericsError
from dehyst.adaptive.types import FloatArray
from dehyst.baselines.common import finite_series, positive


def between_samples(u: FloatArray, factor: int) -> FloatArray:
    """A periodic signal (n,) at ``factor`` times its rate, (n factor,), by its Fourier series."""
    n = u.size
    spectrum = np.fft.rfft(u)
    if n % 2 == 0:
        spectrum[-1] *= 0.5  # the Nyquist line belongs to both of its frequencies
    padded = np.zeros(n * factor // 2 + 1, dtype=np.complex128)
    padded[: spectrum.size] = spectrum
    return np.asarray(np.fft.irfft(padded, n * factor) * factor, dtype=np.float64)


@dataclass(frozen=True, slots=True)
class PeriodicRecord:
    """One period of a force and of the displacement it causes, averaged over many periods.

    Attributes
    ----------
    u_N : (n,) force, N. y_m : (n,) mean displacement of ``periods`` periods, m. dt_s : sample time, s.
    noise_m : standard deviation of that mean, from the scatter of the periods, m; NaN for a single period.
    """

    u_N: FloatArray
    y_m: FloatArray
    dt_s: float
    periods: int
    noise_m: float

    @staticmethod
    def of(u_N: FloatArray, y_m: FloatArray, dt_s: float, length: int, skip: int = 0) -> PeriodicRecord:
        """Average whole periods of ``length`` samples; the first ``skip`` periods are left out.

        Raises InputError where the force is not periodic or the periods are not whole.
        """
        u, y = finite_series("u_N", u_N, 8), finite_series("y_m", y_m, 8)
        count = u.size // length if length > 0 else 0
        if u.size != y.size or count * length != u.size or count <= skip:
            raise InputError(f"u_N, y_m: got {u.size} and {y.size} samples, expected whole periods of {length}")
        us, ys = u.reshape(count, length)[skip:], y.reshape(count, length)[skip:]
        if float(np.max(np.abs(us - us[0]))) > 1e-9 * float(np.max(np.abs(u))):
            raise InputError("u_N: differs from period to period, expected one period repeated")
        kept = count - skip
        noise = float(np.sqrt(np.mean(np.var(ys, axis=0, ddof=1)) / kept)) if kept > 1 else math.nan
        return PeriodicRecord(us[0].copy(), ys.mean(axis=0), positive("dt_s", dt_s, "s"), kept, noise)


def _best_linear_approximation(records: Sequence[PeriodicRecord]) -> tuple[float, float, float]:
    """m kg, c N s/m, k N/m by least squares of the force spectrum on the spectra of y'', y' and y."""
    rows, targets = [], []
    for record in records:
        force, motion = np.fft.rfft(record.u_N), np.fft.rfft(record.y_m)
        used = np.abs(force) > 1e-3 * np.abs(force).max()
        s = 2j * np.pi * np.fft.rfftfreq(record.u_N.size, record.dt_s)[used]
        x, f = motion[used], force[used]
        rows += [np.column_stack([s * s * x, s * x, x]).view(np.float64).reshape(x.size, 3, 2)]
        targets += [f.view(np.float64).reshape(f.size, 2)]
    table = np.concatenate([np.swapaxes(row, 1, 2).reshape(-1, 3) for row in rows])
    size = np.linalg.norm(table, axis=0)
    m, c, k = np.linalg.lstsq(table / size, np.concatenate(targets).ravel(), rcond=None)[0] / size
    return float(m), float(c), float(k)


@compiled
def _slope(
    y: float, v: float, w: float, u: float, theta: FloatArray, unit: bool
) -> tuple[float, float]:  # pragma: no cover - compiled
    """(v', w') at a state; theta = m, c, k, alpha, g, d, nu, s; ``unit``: nu is 1."""
    size = abs(w)
    power = size if unit else size ** theta[6]
    sign = 1.0 if w > 0.0 else -1.0
    acceleration = (u - theta[1] * v - theta[2] * y - theta[3] * theta[7] * w) / theta[0]
    return acceleration, (v - (theta[4] * abs(v) * sign + theta[5] * v) * power) / theta[7]


@compiled
def _integrate(
    u: FloatArray, h: float, every: int, theta: FloatArray, state: FloatArray, out: FloatArray
) -> None:  # pragma: no cover - compiled
    """Write the displacement at every ``every``-th step of ``h`` s to ``out``; ``u``: force at steps and half steps.

    ``state`` (y, v, w) is advanced in place. ``out[0]`` is the displacement before the first step.
    """
    y, v, w = state[0], state[1], state[2]
    unit = abs(theta[6] - 1.0) < 1e-12
    for i in range(out.size):
        out[i] = y
        for j in range(every):
            k = 2 * (i * every + j)
            u0, u1, u2 = u[k % u.size], u[(k + 1) % u.size], u[(k + 2) % u.size]
            a1, b1 = _slope(y, v, w, u0, theta, unit)
            v2 = v + 0.5 * h * a1
            a2, b2 = _slope(y + 0.5 * h * v, v2, w + 0.5 * h * b1, u1, theta, unit)
            v3 = v + 0.5 * h * a2
            a3, b3 = _slope(y + 0.5 * h * v2, v3, w + 0.5 * h * b2, u1, theta, unit)
            v4 = v + h * a3
            a4, b4 = _slope(y + h * v3, v4, w + h * b3, u2, theta, unit)
            y += h / 6.0 * (v + 2.0 * v2 + 2.0 * v3 + v4)
            v += h / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4)
            w += h / 6.0 * (b1 + 2.0 * b2 + 2.0 * b3 + b4)
    state[0], state[1], state[2] = y, v, w


@dataclass(frozen=True, slots=True)
class MechanicalBoucWen:
    """The seven parameters of the oscillator and its displacement scale.

    Attributes
    ----------
    m_kg, c_N_s_per_m, k_N_per_m, alpha_N_per_m : as in the equation of the module.
    g, d : dimensionless; g = beta gamma (alpha s)^nu/alpha, d likewise with delta.
    nu : exponent.
    scale_m : displacement scale s, m; chosen, not identified.

    Raises InputError on values that are not finite or, except c, g and d, not positive.
    """

    m_kg: float
    c_N_s_per_m: float
    k_N_per_m: float
    alpha_N_per_m: float
    g: float
    d: float
    nu: float
    scale_m: float

    def __post_init__(self) -> None:
        for name in ("m_kg", "k_N_per_m", "alpha_N_per_m", "nu", "scale_m"):
            positive(name, getattr(self, name), "")
        if not all(math.isfinite(value) for value in (self.c_N_s_per_m, self.g, self.d)):
            raise InputError(f"c_N_s_per_m, g, d: got {self!r}, expected finite values")

    @property
    def products(self) -> tuple[float, float]:
        """beta gamma and beta delta of the equation of the module, 1/m for nu = 1."""
        share = self.alpha_N_per_m * (self.alpha_N_per_m * self.scale_m) ** -self.nu
        return self.g * share, self.d * share

    def steady_state(self, u_N: FloatArray, dt_s: float, oversample: int = 20, settle: float = 0.5) -> FloatArray:
        """Steady-state displacement (n,) m over one period of the periodic force ``u_N`` (n,) N, ``dt_s`` s apart.

        ``settle`` : periods that are run from rest first; they must outlast the transient. Raises InputError on bad
        arguments, NumericsError where the integration diverges.
        """
        u = finite_series("u_N", u_N, 8)
        if oversample < 1 or not 0.0 < settle < 100.0:
            raise InputError(f"oversample, settle: got {oversample}, {settle}, expected >= 1 and above 0")
        fine = between_samples(u, 2 * oversample)
        return self._steady(fine, u.size, dt_s, oversample, settle)

    def _steady(self, fine: FloatArray, n: int, dt_s: float, oversample: int, settle: float) -> FloatArray:
        theta = np.array(
            [self.m_kg, self.c_N_s_per_m, self.k_N_per_m, self.alpha_N_per_m, self.g, self.d, self.nu, self.scale_m]
        )
        state, h = np.zeros(3), dt_s / oversample
        before = round(settle * n)
        rolled = np.roll(fine, 2 * oversample * before)
        _integrate(rolled, h, oversample, theta, state, np.empty(before))
        out = np.empty(n)
        _integrate(fine, h, oversample, theta, state, out)
        if not np.all(np.isfinite(out)):
            raise NumericsError("mechanical Bouc-Wen: the integration diverged; raise oversample")
        return out


@dataclass(frozen=True, slots=True)
class MechanicalReport:
    """Result of an identification.

    Attributes
    ----------
    rmse_m, noise_m : RMSE against the mean periods, and the noise of these, m.
    evaluations : runs of the model.
    std : (7,) standard deviations of m, c, k, alpha, g, d, nu; relative for the first four.
    """

    rmse_m: float
    noise_m: float
    evaluations: int
    std: FloatArray


#: Starts: share of the linear stiffness that is hysteretic, g, d.
_STARTS = ((0.5, 0.3, 0.0), (0.3, 0.6, 0.0), (0.7, 0.6, -0.3), (0.5, 1.0, 0.5))


def identify_mechanical(
    records: Sequence[PeriodicRecord],
    *,
    oversample: int = 20,
    search_oversample: int = 4,
    progress: Callable[[str], None] = lambda _: None,
) -> tuple[MechanicalBoucWen, MechanicalReport]:
    """All seven parameters from periodic steady-state records, by least squares from several starts.

    The search uses ``search_oversample`` steps per sample, the final fit ``oversample``. ``progress`` gets one line of
    text per start. Raises InputError on records without a positive mass and stiffness, NumericsError where the
    integration diverges.
    """
    if not records:
        raise InputError("records: got none, expected at least one periodic record")
    s = float(np.sqrt(np.mean(np.concatenate([r.y_m for r in records]) ** 2)))
    m, c, k = _best_linear_approximation(records)
    if not (m > 0.0 and k > 0.0):
        raise InputError(
            f"records: their linear part has mass {m:.3g} kg, stiffness {k:.3g} N/m, expected both above 0"
        )
    evaluations = 0

    def model(x: FloatArray) -> MechanicalBoucWen:
        m_kg, c, k, alpha = (float(value) for value in np.exp(np.clip(x[:4], -40.0, 40.0)))
        return MechanicalBoucWen(m_kg, c, k, alpha, float(x[4]), float(x[5]), float(x[6]), s)

    def solve(x: FloatArray, steps: int, limit: int) -> tuple[FloatArray, float, FloatArray]:
        fine = [between_samples(r.u_N, 2 * steps) for r in records]

        def residual(x: FloatArray) -> FloatArray:
            nonlocal evaluations
            evaluations += 1
            found = model(x)
            try:
                parts = [
                    (found._steady(f, r.u_N.size, r.dt_s, steps, 0.5) - r.y_m) * (math.sqrt(r.periods) / s)
                    for f, r in zip(fine, records, strict=True)
                ]
            except NumericsError:
                parts = [np.full(r.u_N.size, 1e3) for r in records]
            return np.concatenate(parts)

        low = np.array([-30.0] * 4 + [-20.0, -20.0, 0.3])
        high = np.array([30.0] * 4 + [20.0, 20.0, 4.0])
        got = least_squares(
            residual, x, bounds=(low, high), x_scale=np.array([0.1, 0.5, 0.1, 0.1, 0.3, 0.3, 0.3]),
            diff_step=1e-6, max_nfev=limit, xtol=1e-12, ftol=1e-12, gtol=1e-12,
        )  # fmt: skip
        weight = sum(r.periods * r.u_N.size for r in records)
        rmse = s * math.sqrt(2.0 * got.cost / weight)
        information = got.jac.T @ got.jac
        variance = 2.0 * got.cost / max(1, got.fun.size - 7)
        std = np.sqrt(variance * np.diag(np.linalg.pinv(information)))
        return np.asarray(got.x, dtype=np.float64), rmse, np.asarray(std, dtype=np.float64)

    tried = []
    for number, (share, g, d) in enumerate(_STARTS, 1):
        start = np.array([math.log(m), math.log(max(c, 1e-3 * math.sqrt(k * m)) * 0.3), math.log(k * (1.0 - share)),
                          math.log(k * share), g, d, 1.0])  # fmt: skip
        x, rmse, _ = solve(start, search_oversample, 40)
        tried.append((rmse, x))
        progress(f"start {number} of {len(_STARTS)}: RMSE {rmse:.3g} m")
    best = min(tried, key=lambda entry: entry[0])
    x, _, std = solve(best[1], oversample, 20)
    found = model(x)
    errors = [found.steady_state(r.u_N, r.dt_s, oversample) - r.y_m for r in records]
    rmse = float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))
    noise = float(np.sqrt(np.mean([r.noise_m**2 for r in records])))
    return found, MechanicalReport(rmse, noise, evaluations, std)
