"""From periodic records to a modal model, its errors on held-out realisations, and the modes that soften by name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any, Final

import numpy as np

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray
from dehyst.sim.modal.fit import QUANTILE_95, FitSettings, ModalFit, fit_modes, refitted
from dehyst.sim.modal.model import output_errors, powers_of
from dehyst.sim.modal.periods import (
    FrequencyResponse,
    LineSpectra,
    PeriodicRecord,
    average,
    frequency_response,
    joined,
    realisations,
)

#: Records whose amplitudes differ by less than this share are of the same amplitude.
SAME_AMPLITUDE: Final = 0.02
#: A pair is listed as a mode where it is damped less than this, ...
MOST_DAMPING: Final = 0.1
#: ... and moves an output by at least this share of the output's rms.
LEAST_SHARE: Final = 0.01
#: What changes with the amplitude, as `Mode` names it; each with its half width.
CHANGES: Final = ("frequency_change", "damping_change", "damping_rise_over_softening")
#: A change is named where it is this many times as large as half of its 95 % interval: many modes are looked at.
CLEAR: Final = 2.0
#: Rise of the damping ratio over the relative fall of the frequency, for a loop of Rayleigh's kind in the stiffness:
#: a stiffness ``k - αX`` at the amplitude X loses ``4/3 αX³`` a cycle, hence 4 / (3π).
RAYLEIGH_RATIO: Final = 4.0 / (3.0 * np.pi)


@dataclass(frozen=True, slots=True)
class Mode:
    """One mode over the range of amplitudes; half widths are those of 95 % intervals.

    Attributes
    ----------
    frequency_hz, frequency_half_hz, damping, damping_half : (levels,) at the amplitudes of the records.
    participation_um : (p,) rms contribution to each output at the middle amplitude.
    frequency_change, frequency_change_half : relative change from the lowest to the highest amplitude.
    damping_change, damping_change_half : change of the damping ratio.
    gain_change : relative change of the residues' norm.
    damping_rise_over_softening, damping_rise_over_softening_half : rise of the damping over the relative fall of the
        frequency; nan for a single amplitude.
    error_share : rise of the held-out error, relative, if this mode's frequency and damping were held at those of the
        middle amplitude and all residues fitted again; 0 for a single amplitude.
    finding : ``steady``; ``damping`` where only that changes; ``softens``, ``stiffens``; ``loop inside the mode`` where
        it softens and the ratio is that of a loop in the stiffness and not 0; ``softens elastically`` where it is 0 and
        not that of a loop.
    """

    frequency_hz: FloatArray
    frequency_half_hz: FloatArray
    damping: FloatArray
    damping_half: FloatArray
    participation_um: FloatArray
    frequency_change: float
    frequency_change_half: float
    damping_change: float
    damping_change_half: float
    gain_change: float
    damping_rise_over_softening: float
    damping_rise_over_softening_half: float
    error_share: float
    finding: str

    def sentence(self, low_V: float, high_V: float) -> str:
        """The mode's change with the amplitude in one sentence."""
        where = f"The mode at {self.frequency_hz[0]:.5g} Hz"
        if self.finding == "steady":
            return f"{where} does not change measurably from {low_V:.3g} to {high_V:.3g} V rms."
        if self.finding == "damping":
            return (
                f"{where} keeps its frequency from {low_V:.3g} to {high_V:.3g} V rms, its damping goes from "
                f"{100.0 * self.damping[0]:.3g} to {100.0 * self.damping[-1]:.3g} % "
                f"(± {100.0 * self.damping_change_half:.2g}). Held constant, the held-out error rises by "
                f"{100.0 * self.error_share:.2g} %."
            )
        verb = "softens" if self.frequency_change < 0.0 else "stiffens"
        text = (
            f"{where} {verb} by {100.0 * abs(self.frequency_change):.3g} ± {100.0 * self.frequency_change_half:.2g} % "
            f"from {low_V:.3g} to {high_V:.3g} V rms, its damping goes from {100.0 * self.damping[0]:.3g} to "
            f"{100.0 * self.damping[-1]:.3g} % (± {100.0 * self.damping_change_half:.2g})"
        )
        kind = {
            "loop inside the mode": ": as a hysteresis loop in its stiffness does",
            "softens elastically": ": the loss does not grow with it, as it would with a loop in its stiffness",
        }.get(self.finding, "")
        if self.finding == "softens" and self.damping_rise_over_softening_half < 0.5 * RAYLEIGH_RATIO:
            share = 100.0 * self.damping_rise_over_softening / RAYLEIGH_RATIO
            kind = f": {share:.2g} % of the loss that a loop of this softening brings"
        return f"{text}{kind}. Held constant, the held-out error rises by {100.0 * self.error_share:.2g} %."


@dataclass(frozen=True, slots=True)
class Level:
    """One amplitude: its training spectra, response matrix, held-out spectra, and errors by output.

    ``train_um`` and ``test_um`` (p,): rms over the realisations; ``test_um`` is None without held-out realisations.
    ``constant_um`` (p,): the same error, held out if possible, of one linear model for all amplitudes.
    """

    response: FrequencyResponse
    test: LineSpectra | None
    train_um: FloatArray
    test_um: FloatArray | None
    constant_um: FloatArray


@dataclass(frozen=True, slots=True)
class ModalStudy:
    """The fit, its errors at each amplitude (ascending), the modes in ascending frequency, and remarks."""

    fit: ModalFit
    levels: tuple[Level, ...]
    modes: tuple[Mode, ...]
    notes: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """The study as JSON data; lengths in µm, frequencies in Hz, voltages in V rms."""
        model = self.fit.model
        return {
            "schema": 1,
            "dt_s": model.dt_s,
            "pairs": model.modes,
            "real_poles": len(model.theta) - 2 * model.modes,
            "degree": model.degree,
            "parameters": self.fit.parameters,
            "converged": self.fit.converged,
            "cost_per_equation": self.fit.cost / self.fit.equations,
            "levels": [_level_dict(level) for level in self.levels],
            "modes": [{f.name: _json(getattr(mode, f.name)) for f in fields(mode)} for mode in self.modes],
            "notes": list(self.notes),
        }


def study(
    records: Sequence[PeriodicRecord],
    tests: Sequence[PeriodicRecord] = (),
    settings: FitSettings | None = None,
    hold_out: int | None = None,
    progress: Callable[[str], None] | None = None,
) -> ModalStudy:
    """Average, fit, and judge.

    Records of one amplitude are joined. At an amplitude without a test record the last ``hold_out`` realisations are
    held out of the fit; None holds out a third of them where more than as many realisations as drives remain.

    Raises InputError where the records do not suffice or do not belong together.
    """
    if not records:
        raise InputError("recordings: got none, expected one or more")
    if hold_out is not None and hold_out < 0:
        raise InputError(f"hold out: got {hold_out} realisations, expected 0 or more")
    say = progress or (lambda _: None)
    trained = _by_amplitude([average(record) for record in records])
    tested = _by_amplitude([average(record) for record in tests]) if tests else []
    notes: list[str] = []
    train: list[LineSpectra] = []
    held: list[LineSpectra | None] = []
    for spectra in trained:
        match = next((t for t in tested if _alike(t.amplitude_V, spectra.amplitude_V)), None)
        if match is not None:
            train.append(spectra)
            held.append(match)
            continue
        count, drives = spectra.u.shape[2], spectra.u.shape[1]
        out = hold_out if hold_out is not None else (count // 3 if count - count // 3 > drives else 0)
        if out > max(0, count - drives):
            raise InputError(
                f"{spectra.name}: hold out: got {out} of {count} realisations, expected at most {count - drives}, so "
                f"that one for each of the {drives} drives remains"
            )
        if out:
            notes.append(
                f"{spectra.name}: no test record of {spectra.amplitude_V:.3g} V rms, so its last {out} of {count} "
                "realisations are held out of the fit"
            )
        train.append(realisations(spectra, slice(0, count - out)))
        held.append(realisations(spectra, slice(count - out, count)) if out else None)
    unused = [t.name for t in tested if not any(_alike(t.amplitude_V, s.amplitude_V) for s in trained)]
    if unused:
        raise InputError(
            f"{unused[0]}: amplitude: got a test record of an amplitude without a training record, expected one of "
            f"{', '.join(f'{s.amplitude_V:.4g}' for s in trained)} V rms"
        )
    notes += [
        f"{s.name}: one period only: the noise is not known; record two or more" for s in trained if s.periods == 1
    ]
    responses = [frequency_response(spectra) for spectra in train]
    fit = fit_modes(responses, settings, say)
    say("judging the modes")
    constant = refitted(fit, responses, np.arange(len(fit.model.theta)), degree=0)
    levels = []
    for response, test in zip(responses, held, strict=True):
        judged = response.spectra if test is None else test
        levels.append(
            Level(
                response=response,
                test=test,
                train_um=_rms(output_errors(fit.model, response.spectra)),
                test_um=None if test is None else _rms(output_errors(fit.model, test)),
                constant_um=_rms(output_errors(constant, judged)),
            )
        )
    return ModalStudy(fit, tuple(levels), tuple(_modes(fit, responses, levels)), tuple(notes))


def _alike(first_V: float, second_V: float) -> bool:
    return abs(first_V / second_V - 1.0) < SAME_AMPLITUDE


def _rms(errors: FloatArray) -> FloatArray:
    """(p,) from (p, R)."""
    return np.asarray(np.sqrt(np.mean(errors**2, axis=1)), dtype=np.float64)


def _by_amplitude(spectra: Sequence[LineSpectra]) -> list[LineSpectra]:
    """Spectra of the same amplitude joined, in ascending order of amplitude."""
    groups: list[list[LineSpectra]] = []
    for one in sorted(spectra, key=lambda s: s.amplitude_V):
        if groups and _alike(one.amplitude_V, groups[-1][0].amplitude_V):
            groups[-1].append(one)
        else:
            groups.append([one])
    return [joined(group) for group in groups]


def _mean_error(levels: Sequence[Level], errors: Callable[[LineSpectra], FloatArray]) -> float:
    """Mean over the amplitudes of the error relative to the output's rms, held out where possible."""
    shares = []
    for level in levels:
        judged = level.response.spectra if level.test is None else level.test
        shares.append(float(np.mean(_rms(errors(judged)) / judged.signal_um)))
    return float(np.mean(shares))


def _modes(fit: ModalFit, responses: Sequence[FrequencyResponse], levels: Sequence[Level]) -> list[Mode]:
    """The pairs that are modes: within the excited band, weakly damped, and large enough in an output."""
    model = fit.model
    amplitudes = [response.spectra.amplitude_V for response in responses]
    low, high = amplitudes[0], amplitudes[-1]
    middle = responses[len(responses) // 2].spectra
    share = model.participation(middle.z, middle.amplitude_V)
    frequency = np.column_stack([model.frequencies_hz(a) for a in amplitudes])
    damping = np.column_stack([model.dampings(a) for a in amplitudes])
    norms = [np.linalg.norm(model.residues(a), axis=(1, 2)) for a in (low, high)]
    band = middle.freq_hz
    base = _mean_error(levels, lambda s: output_errors(model, s))
    found = []
    for i in range(model.modes):
        inside = frequency[i].min() >= band[0] and frequency[i].max() <= band[-1]
        if not inside or damping[i].max() > MOST_DAMPING or not np.any(share[i] > LEAST_SHARE * middle.signal_um):
            continue
        widths = np.array([[fit.interval(row, a) for a in amplitudes] for row in (i, model.modes + i)])
        change = _change(fit, i, low, high)
        error_share = 0.0
        if len(responses) > 1:
            held = refitted(fit, responses, np.array([i, model.modes + i]))
            error_share = _mean_error(levels, lambda s, held=held: output_errors(held, s)) / base - 1.0  # type: ignore[misc]
        found.append(
            Mode(
                frequency_hz=frequency[i],
                frequency_half_hz=frequency[i] * widths[0],
                damping=damping[i],
                damping_half=damping[i] * widths[1],
                participation_um=share[i],
                gain_change=float(norms[1][i] / norms[0][i] - 1.0),
                error_share=error_share,
                finding=_finding(*change.values()),
                **change,
            )
        )
    return sorted(found, key=lambda mode: float(mode.frequency_hz[0]))


def _change(fit: ModalFit, i: int, low_V: float, high_V: float) -> dict[str, float]:
    """Relative change of the frequency, change of the damping ratio, and their ratio, each with its half width, by the
    names that `Mode` has for them.

    First-order propagation from the joint covariance of both rows of ``theta``.
    """
    model = fit.model
    names = [f"{what}{half}" for what in CHANGES for half in ("", "_half")]
    if high_V == low_V:
        return dict(zip(names, (0.0, 0.0, 0.0, 0.0, np.nan, np.nan), strict=True))
    size = model.degree + 1
    rows = np.concatenate([i * size + np.arange(size), (model.modes + i) * size + np.arange(size)])
    covariance = fit.covariance[np.ix_(rows, rows)]
    at_low = powers_of(model.position(low_V), model.degree)
    at_high = powers_of(model.position(high_V), model.degree)
    f = model.frequencies_hz(high_V)[i] / model.frequencies_hz(low_V)[i]
    zeta = model.dampings(low_V)[i], model.dampings(high_V)[i]
    change, rise = f - 1.0, zeta[1] - zeta[0]
    zero = np.zeros(size)
    by_change = np.concatenate([f * (at_high - at_low), zero])
    by_rise = np.concatenate([zero, zeta[1] * at_high - zeta[0] * at_low])
    halves = [QUANTILE_95 * np.sqrt(max(0.0, g @ covariance @ g)) for g in (by_change, by_rise)]
    ratio = ratio_half = np.nan
    if change != 0.0:
        ratio = -rise / change
        by_ratio = -by_rise / change + rise / change**2 * by_change
        ratio_half = QUANTILE_95 * np.sqrt(max(0.0, by_ratio @ covariance @ by_ratio))
    values = change, halves[0], rise, halves[1], ratio, ratio_half
    return {name: float(value) for name, value in zip(names, values, strict=True)}


def _finding(change: float, change_half: float, rise: float, rise_half: float, ratio: float, ratio_half: float) -> str:
    if abs(change) <= CLEAR * change_half:
        return "damping" if abs(rise) > CLEAR * rise_half else "steady"
    if change > 0.0:
        return "stiffens"
    with_loss = abs(ratio - RAYLEIGH_RATIO) <= ratio_half
    without_loss = ratio - ratio_half <= 0.0
    if with_loss and not without_loss:
        return "loop inside the mode"
    return "softens elastically" if without_loss and not with_loss else "softens"


def _level_dict(level: Level) -> dict[str, Any]:
    spectra, test = level.response.spectra, level.test
    return {
        "name": spectra.name,
        "amplitude_V": spectra.amplitude_V,
        "realisations": spectra.u.shape[2],
        "periods": spectra.periods,
        "lines": int(spectra.lines.size),
        "signal_um": spectra.signal_um.tolist(),
        "noise_of_a_reading_um": _json(spectra.noise_um),
        "noise_of_the_mean_period_um": _json(spectra.floor_um),
        "noise_and_distortion_um": _json(level.response.distortion_um) if level.response.knows_distortion else None,
        "train_um": level.train_um.tolist(),
        "test": None if test is None else test.name,
        "test_realisations": 0 if test is None else test.u.shape[2],
        "test_um": None if level.test_um is None else level.test_um.tolist(),
        "test_mean_um": None if level.test_um is None else float(level.test_um.mean()),
        "one_linear_model_for_all_um": level.constant_um.tolist(),
    }


def _json(value: Any) -> Any:
    """A number, a text or an array as JSON has it; None where it is not known."""
    if not isinstance(value, str) and not np.isfinite(value).all():
        return None
    return value.tolist() if isinstance(value, np.ndarray) else value
