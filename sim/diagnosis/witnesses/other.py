"""Cross talk, mains hum and timing, seen in the readings."""

from __future__ import annotations

import numpy as np

from adaptive.types import FloatArray
from sim.diagnosis.witnesses.readings import Readings, Sight
from sim.recordings.repair import runs


def cross_talk(readings: Readings) -> list[Sight]:
    """Motion with the other axis' voltage while this axis' voltage stands still."""
    data = readings.data
    other = data.u2_V
    if other is None or float(np.ptp(other)) == 0.0:
        return [Sight("cross_talk", None, "no other axis is driven")]
    quiet = readings.still & (data.rate_V_per_s == 0.0)
    up = down = 0.0
    left: list[FloatArray] = []
    for a, b in runs(quiet):
        if b - a < 50 or float(np.ptp(other[a:b])) < 0.05 * float(np.ptp(other)):
            continue
        t = np.linspace(-1.0, 1.0, b - a)
        lines = np.stack([np.ones_like(t), t, t * t])
        x = other[a:b] - np.linalg.lstsq(lines.T, other[a:b], rcond=None)[0] @ lines
        y = data.y_um[a:b] - np.linalg.lstsq(lines.T, data.y_um[a:b], rcond=None)[0] @ lines
        up += float(x @ y)
        down += float(x @ x)
        left.append(y - x * (x @ y) / max(float(x @ x), 1e-300))
    if down <= 0.0:
        return [Sight("cross_talk", None, "the other axis never moves while this one stands still")]
    share = up / down
    spread = float(np.std(np.concatenate(left)))
    error = spread / np.sqrt(down)
    gain = max(abs(data.gain_um_per_V), 1e-12)
    words = f"at rest the readings follow the other axis by {100 * share / gain:.3g} ± {196 * error / gain:.1g} %"
    return [Sight("cross_talk", bool(abs(share) > 6.0 * error and abs(share) > 2e-5 * gain), words)]


def mains_hum(readings: Readings) -> list[Sight]:
    """A line at 50 or 60 Hz in the rests, with one phase over all of them, above its neighbours in frequency."""
    data = readings.data
    where = np.concatenate([np.arange(r.first, r.last) for r in readings.rests]) if readings.rests else np.empty(0, int)
    if where.size * data.dt_s < 1.0 or data.dt_s > 1.0 / 130.0:
        return [Sight("mains_hum", None, "less than a second of rests, or fewer than 130 samples a second")]
    width = max(3, round(0.04 / data.dt_s))
    pieces = []
    for r in readings.rests:
        y = data.y_um[r.first : r.last]
        padded = np.pad(y, width, mode="edge")
        pieces.append(y - np.convolve(padded, np.ones(width) / width, "same")[width:-width])
    y = np.concatenate(pieces)
    t = data.t_s[where]
    best: tuple[float, float, float] | None = None
    for mains in (50.0, 60.0):
        grid = mains + np.arange(-0.6, 0.6001, max(0.25 / data.duration_s, 0.004))
        size = np.array([_line(y, t, f) for f in grid])
        i = int(np.argmax(size))
        beside = float(np.median([_line(y, t, float(grid[i]) + d) for d in (-4.3, -3.1, -2.2, 2.2, 3.1, 4.3)]))
        if best is None or size[i] / max(beside, 1e-300) > best[1] / max(best[2], 1e-300):
            best = (float(grid[i]), float(size[i]), beside)
    assert best is not None
    f, size_um, beside = best
    error = float(np.std(y)) * float(np.sqrt(2.0 / y.size))
    words = f"at rest a line at {f:.2f} Hz of {1e3 * size_um:.2g} nm; beside it {1e3 * beside:.1g} nm"
    return [Sight("mains_hum", bool(size_um > max(5.5 * error, 3.0 * beside, 0.05 * readings.sigma_um)), words)]


def _line(y: FloatArray, t: FloatArray, f_hz: float) -> float:
    """Amplitude of a line by correlation."""
    z = 2.0 * np.pi * f_hz * t
    return 2.0 / y.size * float(np.hypot(y @ np.cos(z), y @ np.sin(z)))


def timing(readings: Readings) -> list[Sight]:
    """The time by which the readings are late, in windows of fast motion: its change over the record.

    A clock error makes it grow in proportion to time; lost or doubled samples make it jump by whole samples.
    """
    data = readings.data
    t, d, e = readings.lateness
    if t.size < 6:
        return [Sight("timing", None, "too few stretches of fast motion to date the readings")]
    columns = np.stack([np.ones_like(t), t]) / e
    solved = np.linalg.lstsq(columns.T, d / e, rcond=None)[0]
    left = d / e - solved @ columns
    cover = np.linalg.pinv(columns @ columns.T) * max(1.0, float(left @ left) / max(1, t.size - 2))
    ppm, sigma = 1e6 * solved[1] * data.dt_s, 1e6 * float(np.sqrt(cover[1, 1])) * data.dt_s
    words = f"the readings' lateness changes by {ppm:.3g} ± {1.96 * sigma:.2g} ppm over {t.size} stretches of motion"
    half = t < 0.5 * (t[0] + t[-1])
    parts = [_trend(t[p], d[p], e[p]) * 1e6 * data.dt_s for p in (half, ~half) if int(p.sum()) >= 4]
    steady = len(parts) == 2 and all(abs(part - ppm) < 0.5 * abs(ppm) for part in parts)
    if abs(ppm) > 5.0 * sigma and abs(ppm) > 12.0 and steady:
        return [Sight("timing", True, words)]
    # Slips have dates of their own and are judged by whole samples; without a trend nothing is decided here.
    return [Sight("timing", None, words)]


def _trend(t: FloatArray, d: FloatArray, e: FloatArray) -> float:
    """Weighted slope of d over t."""
    w = 1.0 / e**2
    x = t - float(w @ t) / float(w.sum())
    return float(w @ (x * d)) / max(float(w @ (x * x)), 1e-300)


def slips_are_borne_out(readings: Readings, slips: tuple[tuple[int, int], ...]) -> bool:
    """False where the lateness of the readings does not follow dated slips (first sample, number of samples).

    Whole samples lost or doubled stay until the end of the record. Lateness that wanders by more than they explain is
    a lag, or a limit of the amplifier.
    """
    t, d, _ = readings.lateness
    count = np.zeros_like(t)
    for first, size in slips:
        count += size * (t > first * readings.data.dt_s)
    if t.size < 6 or float(np.ptp(count)) == 0.0:
        # The lateness is not known on both sides of a slip: nothing speaks against it.
        return True
    # The sign of a count is the recorder's; a stage model's own errors are lateness too, of a sample or so.
    wanders = min(float(np.median(np.abs(x - np.median(x)))) for x in (d - count, d + count))
    return wanders < 2.0
