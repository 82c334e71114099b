"""Identification on live hardware (``dehyst commission``): a stage is moved further and further, watched, recorded.

Opening moves nothing. The readings at rest give the noise. Pulses then grow from `START_V` until the stage is seen to
move: there sign and unit are checked against what the controller or the user says. Pulses grow on to the ends of the
stated voltages while the readings have to follow. Rounds of ramps with holds, a decaying sine, a small sweep and a
held-out stretch are recorded and identified until the error on that stretch is small enough or the time is over.

Every voltage passes `Mover`: none is outside the stated limits, none changes faster than the stated slew rate. Whatever
ends the work early, the stage goes back by a ramp to the voltage at which it was found.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np

from dehyst.adaptive.errors import DehystError
from dehyst.adaptive.types import FloatArray
from dehyst.service.adapters.adapter import StageAdapter
from dehyst.service.adapters.recording import StageRecording, excitation, write_recording
from dehyst.service.answers.guard import Limits
from dehyst.service.commissioning.mover import Following, Mover, Order, Piece, StageFault
from dehyst.service.commissioning.probe import Probed, probe, ramps
from dehyst.service.storage.output import atomic_write, check_folder, clear_output
from dehyst.sim.signals.voltages import generalisation_input

#: Names of the files.
RECORDING, MODEL, CONFIGURATION, REPORT = FILES = ("recording.csv", "stage.npz", "serve.toml", "report.json")
#: Shortest ramp and hold of a round, s.
_STAIR_S: Final = 0.4
#: Levels of the ramps with holds, as shares of the range; lengths of the other drives of a round, s.
_STAIRS: Final = (0.5, 1.0, 0.7, 0.3, 0.6, 0.1, 0.0)
_TRAIN_S, _SWEEP_S, _HELD_S = 20.0, 6.0, 16.0
#: The sweep: half its height as a share of the range, and its highest frequency as a share of the sample rate.
_SWEEP_SHARE, _SWEEP_TOP = 0.025, 0.3
#: Share of that frequency up to which its answer is looked at.
_SWEEP_SEEN: Final = 0.9
#: Largest distance from the line of the gain, as a share of the range.
_BAND: Final = 0.4
#: Share of late samples that is named, and least coherence and height of a mode's peak.
_LATE_SHARE, _COHERENT, _PEAK = 0.05, 0.8, 2.0


def drives(rest_V: float, limits: Limits, dt_s: float) -> tuple[FloatArray, slice, int]:
    """(n,) voltages of one round from rest to rest, where its sweep is, and where its held-out stretch begins."""
    low_V, high_V = limits.u_min_V, limits.u_max_V
    span_V, speed = high_V - low_V, 0.5 * limits.slew_V_per_s
    top_hz = _SWEEP_TOP / dt_s
    height_V = min(_SWEEP_SHARE * span_V, speed / (2.0 * math.pi * top_hz))
    t = np.arange(round(_SWEEP_S / dt_s)) * dt_s
    sweep = low_V + 0.5 * span_V + height_V * np.sin(2.0 * np.pi * (0.5 * t + (top_hz - 0.5) / (2.0 * _SWEEP_S) * t**2))
    held = generalisation_input(10.0 / _HELD_S * dt_s, 10.0)[1]
    held = low_V + span_V * (held - held.min()) / np.ptp(held)
    wave = ramps([rest_V, *(low_V + share * span_V for share in _STAIRS)], dt_s, speed, _STAIR_S)[0]
    begins = []
    for part in (sweep, excitation(low_V, high_V, 1.0 / dt_s, _TRAIN_S), held, np.full(1, rest_V)):
        way = ramps([float(wave[-1]), float(part[0])], dt_s, speed, _STAIR_S)[0]
        begins.append(wave.size + way.size)
        wave = np.concatenate([wave, way, part])
    return wave, slice(begins[0], begins[0] + sweep.size), begins[2]


def response(piece: Piece, where: slice, dt_s: float) -> tuple[float | None, float | None]:
    """(lag of a reading behind its voltage, s; first mode, Hz) by the answer to a sweep; None where it is not seen."""
    k, u_V, y_um, timely = (values[where] for values in piece)
    good = timely & np.isfinite(y_um)
    if np.count_nonzero(good) < 0.5 * good.size:
        return None, None
    grid = np.arange(k[0], k[-1] + 1)
    window = np.hanning(grid.size)
    u, y = u_V[np.searchsorted(k, grid, "right") - 1], np.interp(grid, k[good], y_um[good])
    spectra = [np.fft.rfft((x - np.mean(x)) * window) for x in (u, y)]
    smooth = np.ones(9) / 9.0
    uu, yy, yu = (
        np.convolve(a * np.conj(b), smooth, "same")
        for a, b in ((spectra[0], spectra[0]), (spectra[1], spectra[1]), (spectra[1], spectra[0]))
    )
    hz = np.fft.rfftfreq(grid.size, dt_s)
    seen = (hz > 1.0) & (hz < _SWEEP_SEEN * _SWEEP_TOP / dt_s) & (np.abs(yu) ** 2 > _COHERENT * np.abs(uu) * np.abs(yy))
    if np.count_nonzero(seen) < 8:
        return None, None
    transfer, hz = (yu / uu)[seen], hz[seen]
    size = np.abs(transfer)
    peak = int(np.argmax(size))
    mode = size[peak] > _PEAK * float(np.median(size[: max(1, size.size // 4)])) and peak < size.size - 3
    below = slice(0, max(4, int(np.searchsorted(hz, 0.5 * hz[peak])))) if mode else slice(None)
    turn = np.unwrap(np.angle(transfer * np.sign(transfer[0].real)))[below]
    return -float(np.polyfit(hz[below], turn, 1)[0]) / (2.0 * math.pi), float(hz[peak]) if mode else None


def _identified(mover: Mover, recording: Path, model: Path, holdout: float, order: Order) -> dict[str, Any]:
    """What ``dehyst identify`` prints, in a process of its own: the stage is read meanwhile. Raises StageFault."""
    process = subprocess.Popen(
        [
            sys.executable, "-m", "dehyst.service.cli", "identify", str(recording), "--out", str(model), "--json",
            "--quiet", "--no-pictures", "--holdout", f"{holdout:.6f}", "--stage", order.stage, "--axis", order.axis,
        ],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    try:
        mover.hold(lambda: process.poll() is not None)
        printed, said = process.communicate()
    finally:
        process.kill()
        process.communicate()
    if process.returncode:
        raise StageFault("failed", f"identification: {said.strip()}")
    found: dict[str, Any] = json.loads(printed)
    return found


def commission(
    open_stage: Callable[[], StageAdapter], order: Order, out: Path, stopped: Callable[[], str] = str,
    say: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:  # fmt: skip
    """Commission a stage; returns the report, which is also ``report.json`` in the folder ``out``.

    ``out`` is made where it is missing and loses what an earlier commissioning left. It gets ``recording.csv`` and,
    with a model, ``stage.npz`` and ``serve.toml``. ``stopped`` : the reason to stop, "" for none. ``report["fault"]``
    is None, or ``kind``, ``message`` and ``rest``, where the stage is now; without a fault ``report["in_the_way"]``
    says what keeps the error above the target.

    Raises FieldError on limits that do not fit, before anything moves, and what ``open_stage`` raises.
    """
    check_folder(out)
    begun = time.perf_counter()
    mover = Mover(open_stage, order.limits, stopped, begun + order.duration_s)
    report: dict[str, Any] = {"fault": None, "limits": order.limits.to_json(), "target_pct": order.target_pct}
    report["rest_V"] = mover.rest_V
    try:
        clear_output(out, FILES)
        _commission(mover, order, out, begun, report, say)
    except BaseException as error:
        rest = mover.back()
        if not isinstance(error, DehystError | OSError):
            say(f"the stage is {rest}")
            raise
        kind = error.kind if isinstance(error, StageFault) else "failed"
        report["fault"] = {"kind": kind, "message": str(error), "rest": rest}
        if mover.samples and not (out / RECORDING).exists():
            _write(mover, 0, out / RECORDING)
    finally:
        mover.close()
    report["seconds"] = round(time.perf_counter() - begun, 1)
    with atomic_write(out / REPORT) as file:
        file.write((json.dumps(report, indent=1) + "\n").encode())
    return report


def _commission(
    mover: Mover, order: Order, out: Path, begun: float, report: dict[str, Any], say: Callable[[str], None]
) -> None:
    """Fills the report. Raises StageFault, AdapterError and OSError; the stage is then anywhere within the limits."""
    found = probe(mover, order, say)
    report |= {name: getattr(found, name) for name in ("noise_um", "hysteresis", "checked")}
    first, rounds, done = len(mover.samples), 0, False
    while not done:
        round_s = time.perf_counter()
        try:
            report |= _round(mover, found, order, first, out, say)
        except StageFault as fault:
            if fault.kind != "time" or not rounds:
                raise
            say(f"the time is over; the stage is {mover.back()}")
            break
        rounds += 1
        say(f"round {rounds}: {report['error_pct']:.3g} % of the range on the held-out stretch ({report['model']})")
        now = time.perf_counter()
        # Another round brings neither less noise nor more time.
        noisy = report["noise_um"] > target_um(report)
        done = noisy or report["error_um"] <= target_um(report) or now - begun + now - round_s > order.duration_s
    report |= {"rounds": rounds, "in_the_way": in_the_way(report)}
    _write_configuration(out, order)


def _round(
    mover: Mover, found: Probed, order: Order, first: int, out: Path, say: Callable[[str], None]
) -> dict[str, Any]:
    """Drive one round, identify from all samples from the ``first``-th on; what is known then. The files are renewed.

    Raises StageFault, AdapterError and OSError.
    """
    limits, dt_s = order.limits, mover.dt_s
    wave, sweep, held = drives(mover.rest_V, limits, dt_s)
    say(f"{wave.size * dt_s:.0f} s of ramps with holds, a decaying sine, a small sweep, and a stretch to judge by")
    rest, span_V = (mover.rest_V, found.rest_um), limits.u_max_V - limits.u_min_V
    watch = Following(found.gain_um_per_V, rest, span_V, _BAND, found.noise_um, dt_s)
    piece = mover.play(wave, watch)
    with tempfile.TemporaryDirectory(dir=out) as folder:
        path, model = Path(folder) / RECORDING, Path(folder) / MODEL
        recording = _write(mover, first, path)
        begin, last = mover.samples[first][0], int(piece.k[-1])
        say("identifying; the stage rests meanwhile")
        summary = _identified(mover, path, model, (last - int(piece.k[held])) / (last - begin + 1), order)
        for made in (path, model):
            made.replace(out / made.name)
    scores = {name: of["heldout"] for name, of in summary["models"].items() if of["heldout"]}
    best = min(scores, key=lambda name: float(scores[name]["rmse_pct"]))
    lag_s, mode_hz = response(piece, sweep, dt_s)
    return {
        "gain_um_per_V": summary["gain_um_per_V"], "range_um": summary["range_um"],
        "lag_s": lag_s, "mode_Hz": mode_hz, "swept_to_Hz": _SWEEP_SEEN * _SWEEP_TOP / dt_s,
        "model": best, "error_um": scores[best]["rmse_um"], "error_pct": scores[best]["rmse_pct"],
        "samples": recording.t_s.size, "late": recording.late, "drift_um": float(piece.y_um[-1] - found.rest_um),
    }  # fmt: skip


def target_um(report: dict[str, Any]) -> float:
    """The target, µm."""
    return float(0.01 * report["target_pct"] * report["range_um"])


def in_the_way(report: dict[str, Any]) -> list[str]:
    """What keeps the model from its stated target, in words; empty where nothing does."""
    wanted_um, found = target_um(report), []
    if report["noise_um"] > wanted_um:
        found.append(
            f"noise: a reading has {report['noise_um']:.3g} µm rms, more than the target, {wanted_um:.3g} µm: it "
            "cannot show whether the target is met; look at cables, sensor range and bandwidth"
        )
    if report["error_um"] <= wanted_um:
        return found
    if report["late"] > _LATE_SHARE * report["samples"]:
        found.append(f"{report['late']} readings came late: lower rate_Hz of the adapter, or the load of this machine")
    if abs(report["drift_um"]) > wanted_um:
        found.append(f"creep or drift: the reading at rest moved by {report['drift_um']:.3g} µm in a round")
    if report["mode_Hz"]:
        found.append(f"the mode at {report['mode_Hz']:.3g} Hz is excited: state a lower --slew")
    found.append("time: more rounds (--duration), or a larger --target")
    return found


def _write(mover: Mover, first: int, path: Path) -> StageRecording:
    """Write the samples from the ``first``-th on that were in time."""
    k, u_V, y_um, timely = mover.piece(first)
    t_s = (k - k[0]) * mover.dt_s
    late, worst_ms = int(k[-1] - k[0]) + 1 - int(timely.sum()), 1e3 * mover.ticks.worst_late_s
    recording = StageRecording(t_s[timely], u_V[timely], y_um[timely], late, worst_ms)
    write_recording(path, recording)
    return recording


def _write_configuration(out: Path, order: Order) -> None:
    limits = order.limits
    lines = [
        f'stage = "{order.stage}"', 'listen = ["tcp/127.0.0.1:7447"]', "", "[[axis]]", f'name = "{order.axis}"',
        f'model = "{MODEL}"', f"u_min_V = {limits.u_min_V}", f"u_max_V = {limits.u_max_V}",
        f"slew_V_per_s = {limits.slew_V_per_s}", "",
    ]  # fmt: skip
    with atomic_write(out / CONFIGURATION) as file:
        file.write("\n".join(lines).encode())
