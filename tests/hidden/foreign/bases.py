"""Six kinds of hysteresis, each with formulas of its own: displacement over voltage, both as shares of their range.

Every function takes ``x`` (n,), the voltage from 0 (lowest) to 1 (highest), and returns ``w`` (n,), the displacement:
0 at rest, about 1 at x = 1. They begin depolarised, as the nominal stage does. Full loops are symmetric about the
middle of the range, so that none of them is an asymmetry. Constants are drawn from a seed; the major loop is 6 to 16 %
wide. A nominal loop and a sum of plays leave 0.01 % of the range (plays, friction), 0.1 % (relays) or 0.2 to
0.6 % (the two differential equations, whose memory is local).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
F = TypeVar("F", bound=Callable[..., Any])


def loop(function: F) -> F:
    """Compile a loop over samples."""
    return cast(F, numba.njit(cache=True)(function))


# Preisach ------------------------------------------------------------------------------------------------------------


@loop
def _cumulative(c: Array, low: float, step: float, a: float, b: float) -> float:  # pragma: no cover - compiled
    """Integral of the density over (-inf, a] x (-inf, b], bilinear in each cell of the grid."""
    p, q = (a - low) / step, (b - low) / step
    i = min(max(int(p), 0), c.shape[0] - 2)
    j = min(max(int(q), 0), c.shape[0] - 2)
    f, g = p - i, q - j
    left = (1 - g) * c[i, j] + g * c[i, j + 1]
    right = (1 - g) * c[i + 1, j] + g * c[i + 1, j + 1]
    return float((1 - f) * left + f * right)


@loop
def _everett(c: Array, low: float, step: float, a: float, b: float) -> float:  # pragma: no cover - compiled
    """Weight of the relays between the thresholds ``b`` (down) and ``a`` (up), the triangle b <= beta <= alpha <= a.

    The density is stored symmetric about the diagonal, so the triangle is half of a square.
    """
    return 0.5 * (
        _cumulative(c, low, step, a, a) - 2.0 * _cumulative(c, low, step, a, b) + _cumulative(c, low, step, b, b)
    )


@loop
def _first_rise(c: Array, low: float, step: float, top: float) -> float:  # pragma: no cover - compiled
    """Weight of the relays that a depolarised stage switches up to ``top``: |beta| <= alpha <= top."""
    return float(0.5 * _everett(c, low, step, top, -top))


@loop
def _preisach(x: Array, c: Array, low: float, step: float) -> Array:  # pragma: no cover - compiled
    """Relays that the input has switched up, from the depolarised state at 0 on.

    The boundary between up and down is kept as the list of past extremes.
    """
    n = x.shape[0]
    out = np.empty(n)
    most = 4096
    tops, floors = np.empty(most), np.empty(most)
    # Corner k: the input rose to tops[k], then fell to floors[k].
    count = 0
    held, rising, value, previous = 0.0, True, 0.0, x[0]
    for k in range(n):
        now = x[k]
        if now != previous:
            up = now > previous
            if up:
                # Corners below the input are wiped out.
                if not rising or count == 0:
                    rising = True
                while count > 0 and now >= tops[count - 1]:
                    count -= 1
                held = 0.0
                for j in range(count):
                    if j == 0:
                        held += _first_rise(c, low, step, tops[j])
                    else:
                        held += _everett(c, low, step, tops[j], floors[j - 1])
                    held -= _everett(c, low, step, tops[j], floors[j])
                if count == 0:
                    value = _first_rise(c, low, step, now)
                else:
                    value = held + _everett(c, low, step, now, floors[count - 1])
            else:
                if rising:
                    rising = False
                    if count == most:
                        count -= 1
                    tops[count], floors[count] = previous, now
                    count += 1
                while count > 1 and now <= floors[count - 2]:
                    # A lower minimum wipes out the corner before it.
                    floors[count - 2] = now
                    count -= 1
                floors[count - 1] = now
                held = 0.0
                for j in range(count):
                    if j == 0:
                        held += _first_rise(c, low, step, tops[j])
                    else:
                        held += _everett(c, low, step, tops[j], floors[j - 1])
                    held -= _everett(c, low, step, tops[j], floors[j])
                value = held
            previous = now
        out[k] = value
    return out


def preisach_density(spread: float, coercive: float, interaction: float, cells: int = 300) -> tuple[Array, Array]:
    """Grid (cells + 1,) and relay density (cells, cells) as measured on soft ceramics.

    A Gaussian ridge along the diagonal, highest where the half width (alpha - beta) / 2 is ``coercive`` and the centre
    (alpha + beta) / 2 is the middle of the range. ``spread`` and ``interaction`` are its standard deviations. It is
    the same on both sides of 0, so that the depolarised state is the line alpha = -beta.
    """
    grid = np.linspace(-1.05, 1.05, cells + 1)
    mid = 0.5 * (grid[1:] + grid[:-1])
    half, centre = 0.5 * np.abs(mid[:, None] - mid[None, :]), 0.5 * (mid[:, None] + mid[None, :])
    density = np.exp(-0.5 * ((half - coercive) / spread) ** 2 - 0.5 * ((np.abs(centre) - 0.5) / interaction) ** 2)
    return grid, density


def preisach(x: Array, rng: np.random.Generator) -> Array:
    """Relays with a measured-like density, and a reversible share (Preisach 1935, Mayergoyz's form)."""
    u = rng.uniform
    grid, density = preisach_density(u(0.07, 0.1), u(0.04, 0.09), u(0.9, 1.3))
    step = float(grid[1] - grid[0])
    c = np.zeros((grid.size, grid.size))
    c[1:, 1:] = np.cumsum(np.cumsum(density, axis=0), axis=1) * step * step
    c /= _everett(c, float(grid[0]), step, 1.0, 0.0)
    relays = _preisach(np.ascontiguousarray(x), c, float(grid[0]), step)
    share = u(0.35, 0.5)
    return np.asarray((1.0 - share) * x + share * relays)


# Maxwell slip --------------------------------------------------------------------------------------------------------


@loop
def _maxwell(force: Array, spring: float, k: Array, f: Array) -> Array:  # pragma: no cover - compiled
    """Position under a force: a spring beside elements that stick with stiffness ``k`` and slip at the force ``f``.

    Each move goes from slip to slip: between two of them position and force are proportional.
    """
    n, m = force.shape[0], k.shape[0]
    out = np.empty(n)
    own = np.zeros(m)
    position, applied = 0.0, 0.0
    for s in range(n):
        left = force[s] - applied
        while left != 0.0:
            sign = 1.0 if left > 0.0 else -1.0
            stiffness = spring
            nearest = np.inf
            for j in range(m):
                room = f[j] - sign * own[j]
                if room > 1e-15:
                    stiffness += k[j]
                    nearest = min(nearest, room / k[j])
            move = abs(left) / stiffness
            last = move <= nearest
            if not last:
                move = nearest
            for j in range(m):
                room = f[j] - sign * own[j]
                if room > 1e-15:
                    own[j] = sign * f[j] if move * k[j] >= room * (1.0 - 1e-12) else own[j] + sign * move * k[j]
            position += sign * move
            left = 0.0 if last else left - sign * move * stiffness
        applied = force[s]
        out[s] = position
    return out


def maxwell_slip(x: Array, rng: np.random.Generator) -> Array:
    """Elasto-slide elements under a force (Goldfarb and Celanovic 1997)."""
    u = rng.uniform
    count = 25
    reach = np.geomspace(0.01, u(0.3, 0.45), count)
    k = reach ** u(-0.3, 0.1)
    k *= u(0.5, 0.65) / k.sum()
    return np.asarray(_maxwell(np.ascontiguousarray(x), 1.0, k, k * reach)) * u(1.06, 1.1)


# Jiles-Atherton ------------------------------------------------------------------------------------------------------


@loop
def _langevin(h: float) -> float:  # pragma: no cover - compiled
    return h / 3.0 - h * h * h / 45.0 if abs(h) < 0.1 else 1.0 / np.tanh(h) - 1.0 / h


@loop
def _jiles_slope(  # pragma: no cover - compiled
    field: float, m: float, sign: float, a: float, coupling: float, pinning: float, reversible: float
) -> float:
    effective = (field + coupling * m) / a
    gap = _langevin(effective) - m
    near = (_langevin(effective + 1e-4) - _langevin(effective - 1e-4)) / 2e-4 / a
    slope = reversible * near
    if gap * sign > 0.0:
        slope += (1.0 - reversible) * gap / (sign * pinning - coupling * gap)
    return slope / (1.0 - reversible * coupling * near)


@loop
def _jiles(  # pragma: no cover - compiled
    field: Array, m0: float, a: float, coupling: float, pinning: float, reversible: float
) -> Array:
    """Magnetisation-like polarisation, the differential equation by Heun's rule in steps of at most 0.005."""
    n = field.shape[0]
    out = np.empty(n)
    m, previous = m0, field[0]
    for k in range(n):
        gap = field[k] - previous
        if gap != 0.0:
            sign = 1.0 if gap > 0.0 else -1.0
            count = int(abs(gap) / 0.005) + 1
            step = gap / count
            for _ in range(count):
                one = _jiles_slope(previous, m, sign, a, coupling, pinning, reversible)
                two = _jiles_slope(previous + step, m + step * one, sign, a, coupling, pinning, reversible)
                m += 0.5 * step * (one + two)
                previous += step
            previous = field[k]
        out[k] = m
    return out


def jiles_atherton(x: Array, rng: np.random.Generator) -> Array:
    """Polarisation that lags behind an anhysteretic curve (Jiles and Atherton 1986), beside a linear share."""
    u = rng.uniform
    numbers = (u(1.4, 2.0), u(0.02, 0.1), u(0.3, 0.4), u(0.1, 0.25))
    # Two full cycles give the ends of the closed loop. A depolarised stage begins below it.
    cycle = np.concatenate(
        [np.linspace(0, -1, 400), np.tile(np.r_[np.linspace(-1, 1, 800), np.linspace(1, -1, 800)], 2)]
    )
    before = _jiles(cycle, 0.0, *numbers)
    low, high = float(before[-1]), float(before[-801])
    start = low - u(0.08, 0.12) * (high - low)
    polarised = _jiles(2.0 * np.ascontiguousarray(x) - 1.0, start, *numbers)
    share = u(0.2, 0.28)
    return np.asarray((1.0 - share) * x + share * (polarised - start) / (high - low))


# Coleman-Hodgdon -----------------------------------------------------------------------------------------------------


@loop
def _coleman(  # pragma: no cover - compiled
    x: Array, w0: float, rate: float, rise: float, bend: float, slope: float
) -> Array:
    """dw/dt = rate |dx/dt| (f(x) - w) + slope dx/dt with f(x) = rise z + bend arctan(2 z), z = x - 1/2."""
    n = x.shape[0]
    out = np.empty(n)
    w, previous = w0, x[0]
    for k in range(n):
        gap = x[k] - previous
        if gap != 0.0:
            count = int(abs(gap) / 0.01) + 1
            step = gap / count
            for _ in range(count):
                z = previous + 0.5 * step - 0.5
                goal = rise * z + bend * np.arctan(2.0 * z)
                # Implicit midpoint: exact enough at any step, and never unstable.
                pull = 0.5 * rate * abs(step)
                w = (w * (1.0 - pull) + 2.0 * pull * goal + slope * step) / (1.0 + pull)
                previous += step
            previous = x[k]
        out[k] = w
    return out


def coleman_hodgdon(x: Array, rng: np.random.Generator) -> Array:
    """A Duhem model (Coleman and Hodgdon 1986) with an S-shaped middle line."""
    u = rng.uniform
    numbers = (u(4.0, 7.0), u(0.8, 0.9), u(0.02, 0.05), u(0.25, 0.45))
    cycle = np.tile(np.r_[np.linspace(0, 1, 500), np.linspace(1, 0, 500)], 3)
    before = _coleman(cycle, 0.0, *numbers)
    low, high = float(before[-1]), float(before[-501])
    start = low - u(0.08, 0.12) * (high - low)
    w = _coleman(np.ascontiguousarray(x), start, *numbers)
    share = u(0.35, 0.45)
    return np.asarray((1.0 - share) * x + share * (w - start) / (high - low))


# Plays ---------------------------------------------------------------------------------------------------------------


@loop
def _plays(x: Array, radii: Array, weights: Array) -> Array:  # pragma: no cover - compiled
    n, m = x.shape[0], radii.shape[0]
    out = np.empty(n)
    state = np.zeros(m)
    for j in range(m):
        state[j] = x[0]
    previous, total = x[0], 0.0
    for j in range(m):
        total += weights[j] * state[j]
    for k in range(n):
        now = x[k]
        if now != previous:
            total = 0.0
            for j in range(m):
                state[j] = max(now - radii[j], min(now + radii[j], state[j]))
                total += weights[j] * state[j]
            previous = now
        out[k] = total
    return out


def play_sum(x: Array, rng: np.random.Generator) -> Array:
    """Sixty plays, the weights of a gamma density of their radii (Prandtl and Ishlinskii)."""
    u = rng.uniform
    radii = np.linspace(0.004, 0.48, 60)
    weights = radii ** u(0.1, 0.5) * np.exp(-radii / u(0.1, 0.16))
    weights *= u(0.42, 0.55) / weights.sum()
    w = (1.0 - weights.sum()) * x + _plays(np.ascontiguousarray(x), radii, weights)
    return np.asarray(w * u(1.03, 1.07))


# The chapter's own class ---------------------------------------------------------------------------------------------


@loop
def _bouc_wen(x: Array, alpha: float, beta: float, gamma: float) -> Array:  # pragma: no cover - compiled
    n = x.shape[0]
    out = np.empty(n)
    h, previous = 0.0, x[0]
    for k in range(n):
        gap = x[k] - previous
        if gap != 0.0:
            count = int(abs(gap) / 0.0004) + 1
            step = gap / count
            for _ in range(count):
                pull = 0.5 * (beta * abs(step) + gamma * step * (1.0 if h >= 0.0 else -1.0))
                h = (h * (1.0 - pull) + alpha * step) / (1.0 + pull)
            previous = x[k]
        out[k] = h
    return out


def bouc_wen(x: Array, rng: np.random.Generator) -> Array:
    """The class of the nominal stage, by the implicit midpoint rule: nothing is missing in the simulation of it."""
    u = rng.uniform
    h = _bouc_wen(np.ascontiguousarray(x), u(0.42, 0.5), u(6.4, 7.6), u(7.2, 8.2))
    return np.asarray((x - h) * 1.035)


BASES: dict[str, Callable[[Array, np.random.Generator], Array]] = {
    "bouc_wen": bouc_wen,
    "preisach": preisach,
    "maxwell_slip": maxwell_slip,
    "jiles_atherton": jiles_atherton,
    "coleman_hodgdon": coleman_hodgdon,
    "play_sum": play_sum,
}
#: Bases of another class than the nominal stage: `hysteresis_shape` may be named beside the truth.
OTHER_CLASS = tuple(name for name in BASES if name != "bouc_wen")


def displacement(base: str, x: Array, used_before: bool, rng: np.random.Generator) -> tuple[Array, float]:
    """(n,) displacement of one of `BASES` from its depolarised state, and what remains of it as the record begins.

    ``used_before``: two full cycles went before, and their memory is there.
    """
    if not used_before:
        return BASES[base](x, rng), 0.0
    ramp = np.linspace(0.0, 1.0, 300)
    before = np.tile(np.r_[ramp, ramp[::-1]], 2)
    w = BASES[base](np.r_[before, x], rng)
    return np.asarray(w[before.size :]), float(w[before.size - 1])
