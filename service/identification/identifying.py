"""Identify the served models from a recording, and score each on held-out data."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from dehyst.adaptive.errors import DehystError, InputError
from dehyst.adaptive.identification import IdentifyConfig, identify_lssvm
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.smoothing import SmootherConfig, smooth_recording
from dehyst.adaptive.types import BoolArray, FloatArray, InverseModel
from dehyst.baselines import fit_bouc_wen, fit_linear, fit_mpi
from dehyst.baselines.bouc_wen.model import BoucWenInverse
from dehyst.baselines.linear import LinearInverse
from dehyst.baselines.prandtl_ishlinskii.model import MpiInverse
from dehyst.service.protocol.errors import FieldError
from dehyst.service.reports.plot_style import figure, label, legend, line, save
from dehyst.service.viewer.colours import MEASURED, TRAINING, model_colour
from dehyst.sim.recordings import Recording, Repaired

# --- Identification and scores.

#: Names of the models, in the order in which they are identified and shown.
NAMES = ("linear", "bouc_wen", "mpi", "lssvm_frozen", "lssvm_adaptive")
#: How the baselines are fitted.
_FITS: Final[dict[str, Callable[..., Any]]] = {"linear": fit_linear, "bouc_wen": fit_bouc_wen, "mpi": fit_mpi}
#: Share at the beginning of a separate test recording that is not scored: it only settles the models' memory.
SETTLE_SHARE = 0.05
#: Fewest samples for identification, and for scoring.
LEAST_TRAIN, LEAST_TEST = 200, 50


@dataclass(frozen=True, slots=True)
class Score:
    """Free-run error of an inverse model on held-out data.

    The model computes a voltage from the measured motion (smoothed with zero phase). The error is this voltage minus
    the applied one. ``_um`` : the error times the mean gain of the training data. ``_pct`` : that, in percent of the
    displacement range of the training data.
    """

    mae_V: float
    rmse_V: float
    max_V: float
    mae_um: float
    rmse_um: float
    max_um: float
    mae_pct: float
    rmse_pct: float
    max_pct: float


@dataclass(frozen=True, slots=True)
class Identified:
    """One model with its held-out score and the duration of its identification.

    error_V : (n_test,) V, NaN where a sample is not scored. failed : the reason if there is no model.
    """

    name: str
    model: InverseModel | None
    score: Score | None
    error_V: FloatArray
    seconds: float
    failed: str = ""

    def as_dict(self) -> dict[str, Any]:
        """JSON form."""
        scores = {key: round(value, 9) for key, value in asdict(self.score).items()} if self.score else None
        return {"heldout": scores, "seconds": round(self.seconds, 3), "failed": self.failed or None}


@dataclass(frozen=True, slots=True)
class Stretch:
    """Measured samples with their smoothed motion (n, 3). ``valid`` (n,) is False where a sample was filled in."""

    u_V: FloatArray
    y_um: FloatArray
    motion: FloatArray
    valid: BoolArray

    @staticmethod
    def of(repaired: Repaired, every: int = 1) -> Stretch:
        """The samples of a recording; of a long one every ``every``-th, see `thinning`."""
        recording = repaired.recording
        u_V, y_um = (np.ascontiguousarray(values[::every]) for values in (recording.u_V, recording.y_um))
        motion = smooth_recording(y_um, SmootherConfig.for_rate(recording.dt_s * every))
        return Stretch(u_V, y_um, motion, np.ascontiguousarray(repaired.valid[::every]))

    def part(self, start: int, stop: int) -> Stretch:
        return Stretch(self.u_V[start:stop], self.y_um[start:stop], self.motion[start:stop], self.valid[start:stop])

    def __len__(self) -> int:
        return len(self.u_V)


def motion_of(recording: Recording) -> FloatArray:
    """(n, 3) displacement µm, velocity µm/s and acceleration µm/s² at each sample, smoothed with zero phase."""
    return smooth_recording(recording.y_um, SmootherConfig.for_rate(recording.dt_s))


#: Samples of a recording above which only a part of them enters the fits.
FIT_SAMPLES = 100_000
#: Sample times, s, that thinning does not exceed: that of the motion, and that of the fits without a memory over time.
_LONGEST_DT_S, _LONGEST_FIT_DT_S = 1e-3, 4e-3


def thinning(n: int, dt_s: float, most: int) -> int:
    """Every how many-th of ``n`` samples ``dt_s`` apart to use, so that about ``most`` remain; 1 for all.

    Never fewer than one a millisecond: play operators and lags need the turns of the motion. What is still too much
    for a fit is thinned there.
    """
    return max(1, min(-(-n // most), int(_LONGEST_DT_S / dt_s + 1e-9)))


def at_sample_time(model: InverseModel, dt_s: float) -> InverseModel:
    """A model that was identified at another sample time, to be served with points ``dt_s`` s apart.

    Its parameters are in V, µm and s. Only the step of its memory over time changes.
    """
    if isinstance(model, LssvmInverse):
        return replace(model, features=replace(model.features, dt_s=dt_s))
    if isinstance(model, LinearInverse | MpiInverse | BoucWenInverse):
        return replace(model, dt_s=dt_s)
    raise InputError(f"model {model.name!r}: got a {type(model).__name__}, expected one that can be identified")


def split_at(n: int, holdout: float) -> int:
    """Index of the first sample of the held-out last part. Raises InputError if one part is too short."""
    if not 0.0 < holdout < 0.9:
        raise FieldError("--holdout", holdout, "a share of the recording above 0 and below 0.9")
    split = round(n * (1.0 - holdout))
    if split < LEAST_TRAIN or n - split < LEAST_TEST:
        raise InputError(
            f"recording: got {n} samples, {split} to learn from and {n - split} held out, expected at least "
            f"{LEAST_TRAIN} and {LEAST_TEST}: record longer or give --test FILE"
        )
    return split


def _fitted_part(name: str, n: int, dt_s: float, most: int) -> slice:
    """Which of ``n`` samples a baseline is fitted to."""
    every = max(1, min(-(-n // most), int(_LONGEST_FIT_DT_S / dt_s + 1e-9)))
    # Bouc-Wen's fit simulates the stage many times, from rest on: of a recording of many minutes the beginning must do.
    return slice(0, min(n, most * every) if name == "bouc_wen" else n, every)


def identify_one(
    name: str, u_V: FloatArray, y_um: FloatArray, dt_s: float, n: int, most: int = FIT_SAMPLES
) -> InverseModel:
    """The inverse model ``name`` from (m,) voltages V and displacements µm, ``dt_s`` apart; ``n`` support vectors.

    ``most`` : samples that enter a fit; a longer recording is thinned. Raises what its identification
    raises: InputError on data, NumericsError on arithmetic.
    """
    part = _fitted_part(name, len(u_V), dt_s, most)
    u_thin, y_thin, dt_thin = u_V[part], y_um[part], dt_s * part.step
    if name in _FITS:
        model: InverseModel = _FITS[name](u_thin, y_thin, dt_thin, serve_dt_s=dt_s)[0]
        return model
    if name not in NAMES:
        raise FieldError("models", repr(name), f"some of {', '.join(NAMES)}")
    config = IdentifyConfig(n=max(10, min(n, len(u_V) // 2)), rows=max(100, most))
    inputs: Literal["two", "memory"] = "two" if name == "lssvm_frozen" else "memory"
    return identify_lssvm(u_V, y_um, dt_s, inputs=inputs, config=config, name=name)[0]


def free_run(model: InverseModel, before: Stretch | None, test: Stretch) -> FloatArray:
    """(n_test,) voltages, V, of the model for the measured motion of the test.

    ``before`` : the samples just before the test; they only settle the memory. Without them, the memory starts as that
    of a stage at rest at the first test sample.
    """
    first = before if before is not None and len(before) else test
    memory = model.rest_memory(float(first.motion[0, 0]))
    if before is not None and len(before):
        y, v, a = _columns(before)
        memory = model.track(y, v, a, before.u_V, memory)
    y, v, a = _columns(test)
    return model.feedforward(y, v, a, memory).u_V


def _columns(stretch: Stretch) -> tuple[FloatArray, FloatArray, FloatArray]:
    y, v, a = (np.ascontiguousarray(stretch.motion[:, i]) for i in range(3))
    return y, v, a


def score_of(error_V: FloatArray, gain_um_per_V: float, range_um: float) -> Score:
    """Score of (n,) voltage errors, V; NaN entries are ignored."""
    size = np.abs(error_V[np.isfinite(error_V)])
    in_V = (float(np.mean(size)), float(np.sqrt(np.mean(size**2))), float(np.max(size)))
    in_um = tuple(abs(gain_um_per_V) * value for value in in_V)
    return Score(*in_V, *in_um, *(100.0 * value / range_um for value in in_um))


#: Called with the name of a model, the phase that begins, and the share of all work that is done before it.
Progress = Callable[[str, str, float], None]
#: Rough shares of the time that the models and the phases take, for the time left.
_WEIGHTS = {"linear": 0.1, "bouc_wen": 4.0, "mpi": 2.0, "lssvm_frozen": 3.0, "lssvm_adaptive": 4.0}
_PHASES = {"fit": 1.0, "score": 0.4, "fit again from all": 1.2}


def identify_all(
    train: Stretch,
    test: Stretch,
    dt_s: float,
    *,
    follows: bool,
    whole: Stretch | None = None,
    names: tuple[str, ...] = NAMES,
    n: int = 500,
    most: int = FIT_SAMPLES,
    serve_dt_s: float | None = None,
    progress: Progress = lambda _name, _phase, _share: None,
) -> list[Identified]:
    """Identify every model from ``train`` and score it on ``test``.

    ``follows`` : the test continues the training data in time. Otherwise it is a separate recording, and its first
    ``SETTLE_SHARE`` only settles the memory. ``whole`` : if given, the returned models are identified again from this
    data. If a model cannot be identified, its result has ``failed`` set; the other models are not affected.
    ``most`` : see `identify_one`. ``serve_dt_s`` : sample time of the returned models, s, by default ``dt_s``.
    ``progress`` : called before each phase with the model, the phase and the share of the work that is done.
    """
    gain = float(np.polyfit(train.u_V, train.y_um, 1)[0])
    range_um = float(np.ptp(train.motion[:, 0]))
    settle = 0 if follows else max(1, round(SETTLE_SHARE * len(test)))
    before = train if follows else test.part(0, settle)
    scored = test.part(settle, len(test))
    results: list[Identified] = []
    phases = ("fit", "score") if whole is None else ("fit", "score", "fit again from all")
    work = [(name, phase) for name in names for phase in phases]
    total = sum(_WEIGHTS[name] * _PHASES[phase] for name, phase in work)

    def begin(name: str, phase: str) -> None:
        before = work[: work.index((name, phase))]
        progress(name, phase, sum(_WEIGHTS[done] * _PHASES[part] for done, part in before) / total)

    for name in names:
        start = time.perf_counter()
        begin(name, "fit")
        error_V = np.full(len(test), np.nan)
        try:
            model = identify_one(name, train.u_V, train.y_um, dt_s, n, most)
            seconds = time.perf_counter() - start
            begin(name, "score")
            error_V[settle:] = free_run(model, before, scored) - scored.u_V
            error_V[~test.valid] = np.nan
            score = score_of(error_V, gain, range_um)
            parts = [_fitted_part(name, len(data), dt_s, most) for data in (train, whole or train)]
            # Where the training data begin the whole, a model of their beginning alone is that of the whole, too.
            if whole is not None and (name != "bouc_wen" or not follows or parts[0] != parts[1]):
                begin(name, "fit again from all")
                model = identify_one(name, whole.u_V, whole.y_um, dt_s, n, most)
        except (DehystError, np.linalg.LinAlgError) as error:
            results.append(Identified(name, None, None, error_V, time.perf_counter() - start, str(error)))
            continue
        if serve_dt_s is not None and serve_dt_s != dt_s:
            model = at_sample_time(model, serve_dt_s)
        results.append(Identified(name, model, score, error_V, seconds))
    return results


# --- The picture of an identification: measured loop, remaining loop, held-out residual and errors of all models.

#: Names of the models in the legends.
LABELS = {
    "linear": "linear gain",
    "bouc_wen": "Bouc-Wen",
    "mpi": "modified Prandtl-Ishlinskii",
    "lssvm_frozen": "LSSVM, two inputs",
    "lssvm_adaptive": "LSSVM with memory",
}


def draw_identification(
    path: Path,
    title: str,
    train: Stretch,
    test: Stretch,
    dt_s: float,
    results: list[Identified],
    gain_um_per_V: float,
) -> None:
    """Write one PNG: measured loop, remaining loops on held-out data, held-out residual over time, errors.

    Residuals are voltage errors times the mean gain, µm. Raises OSError if the file cannot be written.
    """
    shown = [result for result in results if result.score is not None]
    drawn, axes = figure(2, 2, (12.0, 8.0), title, width_ratios=[1.0, 1.4])
    loop, remaining, residual, bars = axes[0, 0], axes[0, 1], axes[1, 1], axes[1, 0]

    line(loop, train.u_V, train.y_um, color=TRAINING, label="identified from")
    line(loop, test.u_V, test.y_um, color=MEASURED, label="held out")
    label(loop, "voltage u / V", "displacement y / µm", "measured loop")
    legend(loop, loc="upper left")

    best = min(shown, key=lambda result: result.score.rmse_V if result.score else np.inf, default=None)
    for name in dict.fromkeys(["linear", best.name if best else ""]):
        result = next((r for r in shown if r.name == name), None)
        if result is not None:
            motion, error = test.motion[:, 0], result.error_V * 1e3
            line(remaining, motion, error, color=model_colour(name), lw=0.7, label=LABELS[name])
    label(remaining, "displacement y / µm", "voltage error / mV", "remaining loop, held out")
    legend(remaining, loc="best")

    t_s = np.arange(len(test)) * dt_s
    # Without the linear model: its error is many times larger and is visible in the plot above.
    compared = [result for result in shown if result.name != "linear"] or shown
    for result in compared:
        error = result.error_V * abs(gain_um_per_V)
        line(residual, t_s, error, color=model_colour(result.name), label=LABELS[result.name])
    label(residual, "time since the held-out part began / s", "equivalent displacement error / µm")
    residual.set_title("held-out residual, free run", fontsize=9)
    residual.axhline(0.0, color="black", lw=0.5)
    residual.margins(y=0.18)
    legend(residual, loc="upper right", ncols=2)

    values = [result.score.rmse_um for result in shown if result.score]
    names = [result.name for result in shown]
    rows = bars.barh(range(len(names)), values, color=[model_colour(name) for name in names])
    bars.bar_label(rows, labels=[f"{value:.3g}" for value in values], padding=3, fontsize=8)
    bars.set_yticks(range(len(names)), [LABELS[name] for name in names])
    bars.invert_yaxis()
    label(bars, "held-out RMSE, equivalent displacement / µm", "", "held-out error")
    bars.margins(x=0.15)
    save(drawn, path)
