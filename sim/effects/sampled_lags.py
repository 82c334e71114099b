"""Lags and dead time in the frequency response as a recorder samples it: what amplifier, sensor and delay are seen by.

The voltage changes once a sample, by a jump or in a straight line, and the reading falls somewhere into a sample. Both
are part of the response up to half the sampling rate, so that a second lag of less than a sample can be told from a
reading that is taken a little later.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dehyst.adaptive.types import FloatArray
from dehyst.sim.effects.slew_limit import seen as speed_is_limited
from dehyst.sim.fitting.fit_data import ActsOn, FitData, ModelParameter
from dehyst.sim.fitting.stage_model import CauseModel, Guess, single_guesses
from dehyst.sim.readings.sight import Sight

if TYPE_CHECKING:
    from dehyst.sim.readings.readings import Readings, Response


ComplexArray = NDArray[np.complex128]


#: Relative misfit up to which lags describe a response.
_DESCRIBED = 0.08
#: Latest reading, in samples, that the recorder's latch alone may account for.
_LATCH = 1.2


@dataclass(frozen=True)
class LagsOfResponse:
    """What the response shows. ``missing``: what it lacks to show anything; then nothing else is given.

    ``late``: a straight part of the phase; ``lagged``: a lag beside the stage's own. Each with its words. ``lags_s``:
    the time constants, the stage's own among them; ``lag_error_s``: standard error of the shortest.
    """

    missing: str
    late: bool | None = None
    late_words: str = ""
    lagged: bool | None = None
    lag_words: str = ""
    lags_s: tuple[float, ...] = ()
    lag_error_s: float = 0.0


def has_response(readings: Readings) -> bool:
    """Whether the voltage has the power above 5 Hz that a frequency response needs."""
    return readings.response is not None and readings.response.f_hz.size >= 12


def lags_of_response(readings: Readings) -> LagsOfResponse:
    """A delay by its phase in proportion to frequency; a further lag by its arctangent and its fall in gain.

    The stage's own lag is allowed for, and the rise below a mode that a stage file states; a latency of up to one
    sample belongs to the recorder.
    """
    data = readings.data
    response = readings.response
    if response is None or not has_response(readings):
        return LagsOfResponse("the voltage has too little power above 5 Hz for a frequency response")
    if readings.once(speed_is_limited).seen:
        return LagsOfResponse("behind a limit of the speed the response depends on the size of the motion")
    f, gain, sigma = _below_modes(response, data.known_modes_hz)
    own = int(data.has_lag)
    # What happens within a sample is exact for one lag or two, but not for the modes and the loop above them.
    low = f <= 0.6 * response.f_hz[-1]
    if f.size < 10 or f[-1] < 4.0 * f[0] or int(low.sum()) < 10:
        return LagsOfResponse("the response below the first mode is too narrow")
    free = _fit(f[low], gain[low], sigma[low], data.dt_s, lags=1, latest_s=0.05)
    latched = _fit(f[low], gain[low], sigma[low], data.dt_s, lags=1, latest_s=1.5 * data.dt_s)
    late_s, late_error_s = float(free.p[1]), float(free.errors[1])
    delayed = late_s > 1.8 * data.dt_s + 5.0 * late_error_s and free.cost < 0.8 * latched.cost
    # A lag beside a delay is judged with the delay left free.
    latest_s = 0.05 if delayed else 1.5 * data.dt_s
    fewer, more = (_fit(f, gain, sigma, data.dt_s, lags=n, latest_s=latest_s) for n in (own, own + 1))
    lag_s = float(np.min(more.p[4:]))
    lag_error_s = more.product_error / more.product * lag_s
    # Two nearly equal lags are not known apart, but their product is, and it is nothing where there is one.
    lagged: bool | None = more.cost < 0.5 * fewer.cost and more.product > 5.0 * more.product_error
    if not lagged and (
        more.cost < 0.8 * fewer.cost
        or more.off > _DESCRIBED
        or (not delayed and float(fewer.p[1]) > _LATCH * data.dt_s)
        or _fit(f, gain, sigma, data.dt_s, own + 1, latest_s, least_s=0.5 * data.dt_s).cost < 1.2 * fewer.cost
    ):
        # A further lag improves the fit, but its size is not known, or lags of half a sample would not show, or lags do
        # not describe the response, or without it the readings are later than a recorder's latch makes them: it is
        # neither seen nor excluded.
        lagged = None
    # Two lags bend the phase almost like one with a delay.
    either = delayed and lagged and _fit(f, gain, sigma, data.dt_s, own + 1, 1.5 * data.dt_s).cost < 1.25 * more.cost
    if lagged and not delayed:
        late_s, late_error_s = float(more.p[1]), float(more.errors[1])
    words = (
        f"the phase from {f[0]:.2g} to {f[low][-1]:.3g} Hz has a straight part of {1e3 * late_s:.3g} ± "
        f"{1.96e3 * late_error_s:.1g} ms"
    )
    lag_words = (
        f"up to {f[-1]:.3g} Hz a {'second lag' if own else 'lag'} of {1e3 * lag_s:.3g} ± "
        f"{1.96e3 * lag_error_s:.1g} ms lowers the misfit of the response to "
        f"{100 * more.cost / max(fewer.cost, 1e-300):.0f} %"
    )
    # A little more than the recorder's latch is not decided.
    late = None if either else True if delayed else None if late_s > _LATCH * data.dt_s else False
    lags_s = tuple(float(lag) for lag in more.p[4:])
    return LagsOfResponse("", late, words, lagged, lag_words, lags_s, lag_error_s)


@dataclass(frozen=True)
class FurtherLag(CauseModel):
    """A first-order lag beside the stage's own, at the block ``at``."""

    test_answers_to_others: bool = True
    unseen_is_absent: bool = True
    fast: bool = True
    at: ActsOn = ActsOn.DYNAMICS
    #: Without a frequency response, a lag shows only its sum with the stage's own (`delay.Late`).
    told: bool = True

    def missing(self, data: FitData) -> str:
        return "" if self.told else "a frequency response"

    def shown(self, readings: Readings) -> CauseModel:
        return replace(self, told=has_response(readings))

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        dt_s = data.dt_s
        return (ModelParameter("tau_s", "s", 0.0, 0.0, max(0.03, 20.0 * dt_s), max(1e-4, 0.1 * dt_s), self.at),)

    def plausible(self, p: FloatArray, data: FitData) -> bool:
        # A shorter one cannot be told from the recorder's latch and hold.
        return float(p[0]) >= 0.15 * data.dt_s

    def agreement(self, p: FloatArray, readings: Readings) -> str:
        return agrees(float(p[0]), readings)

    def joint_starts(self, nominal: FloatArray, names: tuple[str, ...], data: FitData) -> list[FloatArray]:
        """A short lag of the stage and a long further one. Calibrated alone, the stage's own lag is nearly the sum of
        both, and a fit from there can end at two equal lags."""
        if "tau_s" not in names:
            return []
        at = names.index("tau_s")
        start = nominal.copy()
        start[at] *= 0.2
        return [np.append(start, 0.8 * nominal[at])]

    def guesses(self, data: FitData, residual_um: FloatArray) -> list[Guess]:
        return single_guesses([f * data.dt_s for f in (0.1, 0.3, 1.0, 3.0, 10.0)])


def second_lag(readings: Readings) -> Sight:
    """The direct test of a lag beside the stage's own: its phase and its loss of gain."""
    found = readings.once(lags_of_response)
    return Sight(None, found.missing) if found.missing else Sight(found.lagged, found.lag_words)


def agrees(tau_s: float, readings: Readings) -> str:
    """How a fitted lag agrees with a lag of the response within 15 % or two standard errors; empty if with none."""
    found = readings.once(lags_of_response)
    if not found.lagged:
        return ""
    nearest_s = min(found.lags_s, key=lambda lag_s: abs(lag_s - tau_s))
    if abs(nearest_s - tau_s) > max(0.15 * nearest_s, 2.0 * found.lag_error_s):
        return ""
    return f"the fit has {1e3 * tau_s:.3g} ms"


def _below_modes(response: Response, known_hz: tuple[float, ...]) -> tuple[FloatArray, ComplexArray, FloatArray]:
    """The response up to half the frequency of its largest peak, where it has one.

    Where the stage's mode is known, the rise towards it is taken off.
    """
    f, size = response.f_hz, np.abs(response.gain)
    low = float(np.median(size[: max(3, f.size // 10)]))
    peak = int(np.argmax(size))
    top = 0.5 * float(f[peak]) if size[peak] > 1.5 * low and f[peak] > 4.0 * f[0] else float(f[-1])
    keep = f <= top
    rise = 1.0 / (1.0 - np.square(f[keep] / (2.0 * top))) if known_hz and top < f[-1] else 1.0
    return f[keep], response.gain[keep] / rise, response.sigma[keep]


class _Fitted:
    """Parameters (log gain, latency, lags), their standard errors, and the squared misfit.

    ``product``, ``product_error``: of the lags, s for one and s² for two. ``off``: relative misfit, RMS.
    """

    def __init__(self, p: FloatArray, cover: FloatArray, cost: float, off: float) -> None:
        self.p, self.cost, self.off = p, cost, off
        self.errors = np.sqrt(np.maximum(np.diag(cover), 0.0))
        row = np.zeros(p.size)
        row[4:] = [np.prod(np.delete(p[4:], i)) for i in range(p.size - 4)]
        self.product = float(np.prod(p[4:]))
        self.product_error = float(np.sqrt(max(float(row @ cover @ row), 0.0)))


def _fit(
    f: FloatArray,
    gain: ComplexArray,
    sigma: FloatArray,
    dt_s: float,
    lags: int,
    latest_s: float,
    least_s: float = 1e-6,
) -> _Fitted:
    """The better fit of a voltage that is held over each sample and of one that runs straight to the next.

    ``lags`` 0 is fitted as one lag that is too short to be seen. ``least_s`` is the shortest lag.
    """
    both = (_fit_hold(f, gain, sigma, dt_s, lags, (least_s, latest_s), straight) for straight in (False, True))
    return min(both, key=lambda fitted: fitted.cost)


def _fit_hold(
    f: FloatArray,
    gain: ComplexArray,
    sigma: FloatArray,
    dt_s: float,
    lags: int,
    limits_s: tuple[float, float],
    straight: bool,
) -> _Fitted:
    """``limits_s``: the shortest lag and the longest latency."""
    from scipy import optimize  # a simulated stage does not wait for it

    turn = np.exp(-2j * np.pi * f * dt_s)
    weight = 1.0 / np.maximum(sigma, 0.003)
    size, phase = np.log(np.abs(gain)), np.unwrap(np.angle(gain))
    start_gain = float(size[0])
    pace = np.log(f / f[0])

    def misfit(p: FloatArray) -> FloatArray:
        model = _sampled(turn, np.abs(p[4:]) / dt_s, float(p[1]) / dt_s, straight)
        # A loop adds a small constant phase, and its gain falls slowly with frequency, as the motion gets smaller.
        missing = phase - np.unwrap(np.angle(model)) - p[2]
        missing = missing - 2.0 * np.pi * np.round(missing[0] / (2.0 * np.pi))
        both = np.concatenate([size - p[0] - p[3] * pace - np.log(np.abs(model)), missing]) * np.concatenate(
            [weight, weight]
        )
        return np.asarray(both)

    best: optimize.OptimizeResult | None = None
    least_s, latest_s = limits_s
    for first in (1e-3, 4e-3):
        # More than one start: the second lag hides behind the first.
        start = np.array([start_gain, 0.0, 0.0, 0.0, first if lags else 1.5e-6, *[0.3 * first] * (lags - 1)])
        low = np.array([-50.0, -1.5 * dt_s, -0.3, -0.1, least_s, *[least_s] * (lags - 1)])
        start = np.maximum(start, 1.01 * low)
        high = [50.0, latest_s, 0.3, 0.1, 0.1 if lags else 2e-6, *[0.1] * (lags - 1)]
        scale = [1.0, 1e-3, 0.1, 0.1, 1e-3, 1e-3][: start.size]
        solved = optimize.least_squares(misfit, start, bounds=(low, high), x_scale=scale)
        if best is None or solved.cost < best.cost:
            best = solved
    assert best is not None
    cover = np.linalg.pinv(best.jac.T @ best.jac) * (2.0 * best.cost / max(1, 2 * f.size - best.x.size))
    off = float(np.sqrt(best.cost / np.sum(np.square(weight))))
    return _Fitted(np.asarray(best.x), np.asarray(cover), float(best.cost), off)


def _sampled(turn: ComplexArray, ratios: FloatArray, late: float, straight: bool) -> ComplexArray:
    """Response of one or two lags (time constants over the sample time) as a recorder sees it that reads ``late``
    samples late, exact for a voltage that is held over each sample or runs ``straight`` to the next one."""
    ratios = np.maximum(ratios, 1e-3)
    if ratios.size == 1:
        shares = np.ones(1)
    else:
        apart = ratios[0] - ratios[1]
        if abs(apart) < 1e-3 * float(np.max(ratios)):
            apart = 1e-3 * float(np.max(ratios))
        shares = np.array([ratios[0], -ratios[1]]) / apart
    whole = int(np.floor(late))
    # The reading falls into the step that begins at its last voltage, after this part of it.
    part = 1.0 - (late - whole)
    left, keep = np.exp(-part / ratios)[:, None], np.exp(-1.0 / ratios)[:, None]
    gap = 1.0 - turn
    settling = left / (1.0 - keep * turn)
    if straight:
        ramps = part + (1.0 - part) * turn
        out = ramps - (shares * ratios) @ (gap - gap * gap * settling)
    else:
        out = turn * (1.0 - shares @ (gap * settling))
    return np.asarray(out * turn**whole)
