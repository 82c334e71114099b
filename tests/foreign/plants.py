"""Random stages that share nothing with the project: written from the textbook, for the tests and the benchmark.

A stage is, in this order: an amplifier of first order; hysteresis (one of four kinds, see ``HYSTERESIS``); a slight
bend; creep in logarithmic time; none, one or two lightly damped modes; drift; white noise of the sensor. Nothing of
``sim``, ``adaptive``, ``baselines`` or ``service`` is used but what a plant is told to change.

- Plays: weighted play operators whose thresholds grow with the rate of the voltage (Al Janaideh's form).
- Preisach: by the Everett function of a density that depends on place and width, with the stack of turning points.
- Bouc-Wen: the usual differential equation, without mass.
- Duhem: Coleman and Hodgdon's equation, with a coefficient that depends on place.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from dehyst.lab.rehearsal.plant import Change

FloatArray = NDArray[np.float64]

PLAYS, PREISACH, BOUC_WEN, DUHEM = 0, 1, 2, 3
HYSTERESIS = ("plays", "preisach", "bouc_wen", "duhem")
#: Longest step of the integration, s.
STEP_S = 2.5e-4
#: Turning points that the Preisach stack holds.
STACK = 2048
#: Smallest slope just after a turn, over the mean slope. Of every piezo some part follows the voltage at once; with a
#: slope below 0 a stage would move against its voltage after each turn.
LEAST_SLOPE = 0.1

#: Time of one step of a loop so slow that its rate does not matter, s.
SLOWLY_S = 1e3

# Places in the state vector.
_AMP, _LAG, _V, _Y1, _V1, _Y2, _V2, _TARGET, _COUNT = range(9)
# Places in the vectors of what changes: now, goal, rate a second.
_GAIN, _ZERO, _PAYLOAD, _SLOW = range(4)


@numba.njit(cache=True)
def _everett(a: float, b: float, skew: float, cubic: float) -> float:
    """Weight of the relays between ``b`` and ``a`` in [-1, 1]; 1 for all of them."""
    d = a - b
    return (d * d * (1.0 + skew * (a + b)) + cubic * d * d * d) / (4.0 + 8.0 * cubic)


@numba.njit(cache=True)
def _hysteresis(kind: int, v0: float, v1: float, h_s: float, p: FloatArray, w: FloatArray, z: FloatArray) -> float:
    """Output for the normalised voltage going from v0 to v1 within h_s, s; ``z`` is the memory, changed in place."""
    dv = v1 - v0
    if kind == PLAYS:
        grown = 1.0 + p[0] * min(abs(dv) / h_s, 20.0)
        total = 0.0
        for i in range(w.size):
            r = p[1 + i] * grown
            z[i] = max(v1 - r, min(v1 + r, z[i]))
            total += w[i] * z[i]
        return total
    if kind == PREISACH:
        # z[0]: number of points; then the turning points, the last one being where the input is.
        x = min(1.0, max(-1.0, 2.0 * v1 - 1.0))
        m = int(z[0])
        last = z[m]
        if x != last:
            rising = True if m < 2 else z[m] > z[m - 1]
            if (x > last) == rising and m >= 2:
                z[m] = x
            else:
                if m + 2 >= z.size:
                    m -= 2
                m += 1
                z[m] = x
            while m >= 3 and abs(z[m] - z[m - 1]) >= abs(z[m - 2] - z[m - 1]):
                z[m - 2] = z[m]
                m -= 2
            z[0] = m
        total = 0.0
        for i in range(2, m + 1):
            if z[i] > z[i - 1]:
                total += _everett(z[i], z[i - 1], p[0], p[1])
            else:
                total -= _everett(z[i - 1], z[i], p[0], p[1])
        return total
    if kind == BOUC_WEN:
        # Heun's rule over steps that are short beside the way on which it saturates.
        steps = 1 + int(abs(dv) / (0.05 * p[3]))
        d = dv / steps
        y = z[0]
        for _ in range(steps):
            power = abs(y) ** p[2]
            k1 = d - p[0] * abs(d) * math.copysign(power, y) - p[1] * d * power
            there = y + k1
            power = abs(there) ** p[2]
            k2 = d - p[0] * abs(d) * math.copysign(power, there) - p[1] * d * power
            y += 0.5 * (k1 + k2)
        z[0] = y
        return v1 - y
    # The exact solution for a voltage that goes from v0 to v1 at one coefficient.
    alpha = p[0] * (1.0 + p[2] * (v1 - 0.5))
    faded = math.exp(-alpha * abs(dv))
    side = 1.0 if dv > 0.0 else -1.0
    z[0] = v1 - faded * (v0 - z[0]) - side * (1.0 - p[1]) / alpha * (1.0 - faded)
    return z[0]


@numba.njit(cache=True)
def _loop(kind: int, n: int, p: FloatArray, w: FloatArray, z: FloatArray) -> FloatArray:
    """(4, n) output over up, down, up, down of the whole voltage, slowly."""
    out = np.empty((4, n))
    v = 0.0
    for branch in range(4):
        for k in range(n):
            share = (k + 1.0) / n
            new = share if branch % 2 == 0 else 1.0 - share
            out[branch, k] = _hysteresis(kind, v, new, SLOWLY_S, p, w, z)
            v = new
    return out


@numba.njit(cache=True)
def _oscillate(y: float, v: float, s: float, omega: float, zeta: float, h: float) -> tuple[float, float]:
    """Displacement and velocity after ``h`` seconds of y'' = omega² (s - y) - 2 zeta omega y', exactly."""
    wd = omega * math.sqrt(1.0 - zeta * zeta)
    e, c, d = math.exp(-zeta * omega * h), math.cos(wd * h), math.sin(wd * h)
    x = y - s
    tilt = (v + zeta * omega * x) / wd
    return s + e * (x * c + tilt * d), e * (v * c - (zeta * omega * tilt + wd * x) * d)


@numba.njit(cache=True)
def _run(
    u: FloatArray, true: FloatArray, c: FloatArray, kind: int, p: FloatArray, w: FloatArray, z: FloatArray,
    creep: FloatArray, s: FloatArray, change: FloatArray, modes: FloatArray,
) -> None:  # fmt: skip
    """Advance by u.size samples; ``s``, ``z``, ``creep[2]`` and ``change[0]`` are the state."""
    dt, u_min, span, tau, low, size, mix, b2, b3, scale, v_rest, offset, steps_ = c[:13]
    drift_um, drift_Hz, drift_phase = c[13:16]
    steps = int(steps_)
    h = dt / steps
    keep = math.exp(-h / tau) if tau > 0.0 else 0.0
    for k in range(u.size):
        if modes.shape[0] == 0:
            true[k] = s[_TARGET]
        elif modes.shape[0] == 1:
            true[k] = s[_Y1]
        else:
            true[k] = (1.0 - modes[1, 2]) * s[_Y1] + modes[1, 2] * s[_Y2]
        for i in range(4):
            left = change[1, i] - change[0, i]
            most = change[2, i] * dt
            change[0, i] += min(max(left, -most), most)
        slow = change[0, _SLOW]
        keep_slow = math.exp(-h / slow) if slow > 0.0 else 0.0
        heavier = 1.0 / math.sqrt(1.0 + change[0, _PAYLOAD])
        t = s[_COUNT] * dt
        drift = drift_um * (math.sin(6.283185307179586 * drift_Hz * t + drift_phase) - math.sin(drift_phase))
        for _ in range(steps):
            s[_AMP] = u[k] + (s[_AMP] - u[k]) * keep
            s[_LAG] = s[_AMP] + (s[_LAG] - s[_AMP]) * keep_slow
            v = (s[_LAG] - u_min) / span
            y = (_hysteresis(kind, s[_V], v, h, p, w, z) - low) / size
            s[_V] = v
            x = (1.0 - mix) * v + mix * y
            g = x + 4.0 * b2 * x * (1.0 - x) + 10.0 * b3 * x * (1.0 - x) * (x - 0.5)
            total = g
            for i in range(creep.shape[1]):
                creep[2, i] = g + (creep[2, i] - g) * math.exp(-h / creep[1, i])
                total += creep[0, i] * creep[2, i]
            new = offset + scale * change[0, _GAIN] * (total - v_rest) + change[0, _ZERO] + drift
            middle = 0.5 * (s[_TARGET] + new)
            s[_TARGET] = new
            if modes.shape[0] > 0:
                s[_Y1], s[_V1] = _oscillate(s[_Y1], s[_V1], middle, modes[0, 0] * heavier, modes[0, 1], h)
            if modes.shape[0] > 1:
                s[_Y2], s[_V2] = _oscillate(s[_Y2], s[_V2], middle, modes[1, 0] * math.sqrt(heavier), modes[1, 1], h)
        s[_COUNT] += 1.0


@dataclass(frozen=True, slots=True)
class Traits:
    """What a stage is; displacement µm, voltage V, time s, frequency Hz.

    Attributes
    ----------
    range_um : displacement over the whole drive, negative where it shrinks with the voltage. offset_um : at 0 V.
    width : of the largest loop, as a share of the range. bend2, bend3 : largest deviation of the bends.
    creep_s, creep : time constants and shares. modes : (frequency, damping ratio, share) of each.
    drift_um, drift_s : amplitude and period. excite_V : the voltages that an identification goes through.
    parameters, weights : of the hysteresis.
    """

    seed: int
    hysteresis: str
    dt_s: float
    u_min_V: float
    u_max_V: float
    excite_V: tuple[float, float]
    range_um: float
    offset_um: float
    width: float
    bend2: float
    bend3: float
    creep_s: tuple[float, ...]
    creep: tuple[float, ...]
    modes: tuple[tuple[float, float, float], ...]
    amplifier_s: float
    drift_um: float
    drift_s: float
    noise_um: float
    parameters: tuple[float, ...]
    weights: tuple[float, ...]

    def summary(self) -> dict[str, Any]:
        """What is worth telling of it, for JSON."""
        return {key: value for key, value in asdict(self).items() if key not in ("parameters", "weights")}


class RandomStage:
    """A stage with the traits given; a plant that takes every physical event itself."""

    def __init__(self, traits: Traits) -> None:
        self.traits = traits
        self.dt_s, self.u_min_V, self.u_max_V = traits.dt_s, traits.u_min_V, traits.u_max_V
        self._noise = np.random.default_rng([traits.seed, 77])
        self._kind = HYSTERESIS.index(traits.hysteresis)
        self._p, self._w = np.array(traits.parameters), np.array(traits.weights)
        low, size, mix = _fitted(self._kind, self._p, self._w, traits.width)
        span = self.u_max_V - self.u_min_V
        rest_V = min(max(0.0, self.u_min_V), self.u_max_V)
        v_rest = (rest_V - self.u_min_V) / span
        phase = float(np.random.default_rng([traits.seed, 78]).uniform(0.0, 2.0 * math.pi))
        self._c = np.array(
            [
                self.dt_s, self.u_min_V, span, traits.amplifier_s, low, size, mix, traits.bend2, traits.bend3,
                traits.range_um, v_rest, traits.offset_um, math.ceil(self.dt_s / STEP_S - 1e-9), traits.drift_um,
                1.0 / traits.drift_s, phase,
            ]
        )  # fmt: skip
        self._creep = np.array([traits.creep, traits.creep_s, [0.0] * len(traits.creep)]).reshape(3, -1)
        self._modes = np.array([(2.0 * math.pi * f, zeta, share) for f, zeta, share in traits.modes]).reshape(-1, 3)
        self._change = np.array([[1.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0] * 4])
        self._z = _memory(self._kind, self._w.size)
        self._s = np.zeros(9)
        self._rest(rest_V, v_rest)

    def _rest(self, rest_V: float, v_rest: float) -> None:
        """Come to rest at a voltage: by way of it from the lowest, all that creeps having crept."""
        y = 0.0
        for v in np.linspace(0.0, v_rest, 50):
            y = _hysteresis(self._kind, max(0.0, v - v_rest / 49.0), v, SLOWLY_S, self._p, self._w, self._z)
        low, size, mix, b2, b3 = self._c[4:9]
        x = (1.0 - mix) * v_rest + mix * (y - low) / size
        g = x + 4.0 * b2 * x * (1.0 - x) + 10.0 * b3 * x * (1.0 - x) * (x - 0.5)
        self._creep[2] = g
        target = self._c[11] + self._c[9] * (g * (1.0 + self._creep[0].sum()) - self._c[10])
        self._s[[_AMP, _LAG, _V, _TARGET, _Y1, _Y2]] = rest_V, rest_V, v_rest, target, target, target

    def run(self, u_V: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n,) true displacement and reading, µm, under (n,) voltages."""
        u = np.ascontiguousarray(u_V, dtype=np.float64)
        true_um = np.empty(u.size)
        _run(
            u, true_um, self._c, self._kind, self._p, self._w, self._z, self._creep, self._s, self._change, self._modes
        )
        return true_um, true_um + self.traits.noise_um * self._noise.standard_normal(u.size)

    def change(self, change: Change) -> bool:
        """Take a physical event; a knock only where there is a mode to ring."""
        if change.kind == "knock":
            if not len(self._modes):
                return False
            self._s[_V1] += change.size * self._modes[0, 0]
            return True
        places = {"gain": _GAIN, "zero": _ZERO, "payload": _PAYLOAD, "lag": _SLOW}
        if change.kind not in places:
            return False
        at = places[change.kind]
        goal = self._change[1, at] * (1.0 + change.size) if change.kind == "gain" else self._change[1, at] + change.size
        way = abs(goal - self._change[0, at])
        self._change[1, at] = goal
        self._change[2, at] = way / change.over_s if change.over_s else math.inf
        return True


@dataclass(frozen=True, slots=True)
class StageFactory:
    """Makes stages of the same traits, each new, at rest, with the same noise."""

    traits: Traits

    def __call__(self) -> RandomStage:
        return RandomStage(self.traits)


def _memory(kind: int, n: int) -> FloatArray:
    if kind == PREISACH:
        z = np.zeros(STACK)
        z[:2] = 1.0, -1.0
        return z
    return np.zeros(n if kind == PLAYS else 1)


def _fitted(kind: int, p: FloatArray, w: FloatArray, width: float) -> tuple[float, float, float]:
    """(lowest output, its span, share of hysteresis) by which the largest loop is as wide as it is to be."""
    out = _loop(kind, 400, p, w, _memory(kind, w.size))[2:]
    low, high = float(out[1, -1]), float(out[0, -1])
    up = np.concatenate([[low], out[0]])
    down = np.concatenate([[high], out[1]])[::-1]
    return low, high - low, width / float(((down - up) / (high - low)).max())


def _least_slope(kind: int, p: FloatArray, w: FloatArray, step: float = 0.002) -> float:
    """The smallest slope of the hysteresis just after a turn on either branch of the largest loop."""
    slopes = []
    for turn in np.linspace(0.1, 1.0, 10):
        for ends, back in (((1.0, 0.0, turn), -step), ((1.0, 0.0, 1.0, 1.0 - turn), step)):
            z, v, y = _memory(kind, w.size), 0.0, 0.0
            for end in ends:
                for new in np.linspace(v, end, 401)[1:]:
                    y, v = _hysteresis(kind, v, new, SLOWLY_S, p, w, z), new
            slopes.append((_hysteresis(kind, v, v + back, SLOWLY_S, p, w, z) - y) / back)
    return min(slopes)


def _possible_width(kind: int, parameters: Sequence[float], weights: Sequence[float], width: float) -> float:
    """The width of the largest loop, or the largest that a stage with this hysteresis can have: see `LEAST_SLOPE`."""
    p, w = np.array(parameters), np.array(weights)
    _, size, share = _fitted(kind, p, w, width)
    steeper = 1.0 - _least_slope(kind, p, w) / size
    return width if share * steeper <= 1.0 - LEAST_SLOPE else width * (1.0 - LEAST_SLOPE) / (share * steeper)


def random_plant(seed: int, as_drawn: bool = False) -> StageFactory:
    """A stage drawn from the whole family. ``as_drawn``: with a loop as wide as drawn, also where no piezo has it."""
    rng = np.random.default_rng([seed, 20])

    def between(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(math.log(low), math.log(high))))

    kind = int(rng.choice(4, p=[0.4, 0.2, 0.2, 0.2]))
    dt_s = 1.0 / float(rng.choice([500.0, 1000.0, 2000.0, 5000.0, 10000.0], p=[0.1, 0.55, 0.17, 0.1, 0.08]))
    drives = ((0, 10), (-2, 10), (0, 100), (-20, 120), (0, 150), (0, 1000), (-100, 1000), (-500, 500), (-10, 10))
    u_min, u_max = (float(u) for u in drives[int(rng.integers(len(drives)))])
    excite = (u_min, u_max)
    if rng.uniform() < 0.5:  # some leave room at the ends
        span = u_max - u_min
        excite = (
            u_min + span * rng.uniform(0.02, 0.1) if u_min < 0.0 else u_min,
            u_max - span * rng.uniform(0.02, 0.2),
        )
    range_um = between(1.0, 500.0) * (1.0 if rng.uniform() < 0.75 else -1.0)
    size = abs(range_um)
    # Some ring faster than the samples can show.
    fastest = 1000.0 if rng.uniform() < 0.25 else min(1000.0, 0.45 / dt_s)
    modes: list[tuple[float, float, float]] = []
    for share in (1.0, between(0.03, 0.3))[: int(rng.choice([0, 1, 2], p=[0.2, 0.5, 0.3]))]:
        modes.append((between(100.0, fastest), between(0.005, 0.3), share))
    modes.sort()
    if len(modes) == 2:
        share = min(m[2] for m in modes)
        modes = [(modes[0][0], modes[0][1], 1.0), (modes[1][0], modes[1][1], share)]
    n_creep = int(rng.integers(4))
    parameters, weights = _drawn_hysteresis(kind, rng)
    offset_um = size * float(rng.choice([0.0, rng.uniform(-1.0, 1.0), rng.uniform(-10.0, 10.0)]))
    width = float(rng.uniform(0.08, 0.2))
    return StageFactory(
        Traits(
            seed=seed,
            hysteresis=HYSTERESIS[kind],
            dt_s=dt_s,
            u_min_V=u_min,
            u_max_V=u_max,
            excite_V=excite,
            range_um=range_um,
            offset_um=offset_um,
            width=width if as_drawn else _possible_width(kind, parameters, weights, width),
            bend2=float(rng.uniform(-0.03, 0.03)),
            bend3=float(rng.uniform(-0.03, 0.03)),
            creep_s=tuple(0.1 * 10.0**i * float(rng.uniform(0.5, 2.0)) for i in range(n_creep)),
            creep=tuple(float(rng.uniform(0.005, 0.02)) for _ in range(n_creep)),
            modes=tuple(modes),
            amplifier_s=between(1e-4, 2e-3),
            drift_um=size * float(rng.choice([0.0, between(1e-4, 3e-3)])),
            drift_s=between(60.0, 600.0),
            noise_um=min(between(5e-4, 5e-2), 5e-4 * size),
            parameters=parameters,
            weights=weights,
        )
    )


def issue_plant(seed: int) -> StageFactory:
    """A stage like those that the table of the issue was made with: plays at 1 kHz with one lightly damped mode."""
    rng = np.random.default_rng([seed, 21])
    parameters, weights = _drawn_hysteresis(PLAYS, rng, (25, 70))
    mode = (float(np.exp(rng.uniform(math.log(180.0), math.log(450.0)))), float(rng.uniform(0.02, 0.1)), 1.0)
    return StageFactory(
        Traits(
            seed=seed,
            hysteresis="plays",
            dt_s=1e-3,
            u_min_V=-2.0,
            u_max_V=10.0,
            excite_V=(0.0, 7.85),
            range_um=float(rng.uniform(90.0, 150.0)),
            offset_um=0.0,
            width=_possible_width(PLAYS, parameters, weights, float(rng.uniform(0.1, 0.16))),
            bend2=float(rng.uniform(-0.02, 0.02)),
            bend3=0.0,
            creep_s=tuple(0.1 * 10.0**i * float(rng.uniform(0.7, 1.5)) for i in range(3)),
            creep=tuple(float(rng.uniform(0.005, 0.015)) for _ in range(3)),
            modes=(mode,),
            amplifier_s=2e-4,
            drift_um=0.0,
            drift_s=100.0,
            noise_um=float(rng.uniform(3e-3, 8e-3)),
            parameters=parameters,
            weights=weights,
        )
    )


def with_traits(factory: StageFactory, **changes: Any) -> StageFactory:
    """The same stage with some traits replaced."""
    return StageFactory(replace(factory.traits, **changes))


def _drawn_hysteresis(
    kind: int, rng: np.random.Generator, plays: tuple[int, int] = (8, 70)
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """(parameters, weights) of a kind; how wide its loop is comes after, by its share."""
    if kind == PLAYS:
        n = int(rng.integers(plays[0], plays[1] + 1))
        thresholds = np.sort(rng.uniform(0.002, 1.0, n)) * rng.uniform(0.3, 0.48)
        weights = rng.exponential(1.0, n) * np.exp(-thresholds / rng.uniform(0.1, 0.5))
        return (float(rng.uniform(0.0, 0.03)), *thresholds.tolist()), tuple((weights / weights.sum()).tolist())
    if kind == PREISACH:
        return (float(rng.uniform(-0.2, 0.2)), float(rng.uniform(-0.08, 0.3))), ()
    if kind == BOUC_WEN:
        way, n, ratio = float(rng.uniform(0.2, 0.45)), float(rng.choice([1.0, 1.0, 1.5, 2.0])), rng.uniform(0.0, 1.0)
        total = way**-n
        return (total / (1.0 + ratio), total * ratio / (1.0 + ratio), n, way), ()
    return (float(rng.uniform(2.5, 7.0)), float(rng.uniform(0.0, 0.3)), float(rng.uniform(-0.5, 0.5))), ()
