"""Drives of seven kinds as shares of the voltage range, each with rests: x (n,) of this axis, x2 (n,) of the other one.

Every drive begins with a second of rest at 0 and ends with one. Steps, ramps and rests are long enough that each kind
shows the effects of `SHOWS`.
"""

from __future__ import annotations

import itertools

import numpy as np

from tests.hidden.excitation import FS_HZ, excitation
from tests.hidden.foreign.bases import Array

#: What each kind of drive makes visible, besides noise, quantisation and hum.
_ALWAYS = {
    "hysteresis_shape",
    "thermal_drift",
    "gain_drift",
    "sensor_nonlinearity",
    "asymmetry",
    "mains_hum",
    "quantisation",
    "saturation",
}
_EDGES = {"amplifier_lag", "sensor_lag", "delay", "resonance", "payload_change", "slew_limit"}
SHOWS: dict[str, set[str]] = {
    "staircase": _ALWAYS | _EDGES | {"creep", "timing"},
    "triangles": _ALWAYS | {"rate_dependence", "stick_slip", "creep", "timing"},
    "raster": _ALWAYS | {"cross_talk", "timing", "delay", "stick_slip", "amplifier_lag", "sensor_lag"},
    "multisine": _ALWAYS | {"amplifier_lag", "sensor_lag", "delay", "resonance", "timing", "rate_dependence", "creep"},
    "mixed": _ALWAYS | _EDGES | {"creep", "rate_dependence", "stick_slip", "cross_talk", "timing"},
    "steps_and_sines": _ALWAYS | _EDGES | {"creep", "rate_dependence", "cross_talk", "timing", "stick_slip"},
    "excitation": _ALWAYS | _EDGES | {"creep", "rate_dependence", "cross_talk", "timing", "stick_slip"},
}


def _hold(level: float, seconds: float, fs: float) -> Array:
    return np.full(max(1, round(seconds * fs)), level)


def _ramp(start: float, stop: float, per_s: float, fs: float) -> Array:
    count = max(2, round(abs(stop - start) / per_s * fs))
    return start + (stop - start) * np.arange(1, count + 1) / count


def _filled(part: list[Array], n: int) -> Array:
    """The parts up to ``n`` samples, then a ramp back to 0 and a rest."""
    x = np.concatenate(part)[:n]
    return np.pad(x, (0, max(0, n - x.size)), constant_values=float(x[-1]))


def staircase(n: int, fs: float, rng: np.random.Generator) -> Array:
    """Steps up and down between random levels, held for 0.6 to 4 s; every second run in equal steps to the top."""
    parts = [_hold(0.0, 1.0, fs)]
    total, turn = parts[0].size, 0
    while total < n:
        if turn % 2 == 0:
            count = int(rng.integers(3, 7))
            levels = np.r_[np.arange(1, count + 1), np.arange(count - 1, -1, -1)] / count
        else:
            levels = np.r_[rng.uniform(0.1, 1.0, int(rng.integers(3, 7))), 0.0]
        for level in levels:
            parts.append(_hold(float(level), float(rng.choice([0.6, 0.8, 1.2, 2.0, 4.0])), fs))
            total += parts[-1].size
        turn += 1
    return _filled(parts, n)


def triangles(n: int, fs: float, rng: np.random.Generator) -> Array:
    """Nested triangles at rates over three decades, with rests at 0 and at a level between."""
    parts = [_hold(0.0, 1.0, fs)]
    total = parts[0].size
    rates = [0.4, 4.0, 40.0, 1.5, 15.0]
    turn = int(rng.integers(len(rates)))
    while total < n:
        rate = rates[turn % len(rates)] * rng.uniform(0.8, 1.25)
        at, own = 0.0, []
        nested = [1.0, 0.15, 0.85, 0.3, 0.7, 0.0] if rate > 1.0 else [1.0, 0.3, 0.8, 0.0]
        repeats = 1 if rate < 3.0 else (3 if rate < 10.0 else 12)
        for level in nested * repeats:
            goal = float(np.clip(level + rng.uniform(-0.04, 0.04), 0.0, 1.0)) if 0.0 < level < 1.0 else level
            own.append(_ramp(at, goal, rate, fs))
            at = goal
        own.append(_hold(at, 0.9, fs))
        if turn % 2:
            middle = float(rng.uniform(0.3, 0.8))
            own += [_ramp(at, middle, 2.0, fs), _hold(middle, 2.0, fs), _ramp(middle, 0.0, 2.0, fs), _hold(0, 0.7, fs)]
        parts += own
        total += sum(part.size for part in own)
        turn += 1
    return _filled(parts, n)


def raster(n: int, fs: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """Frames of a scan: triangle lines on this axis, slow lines on the other one, rests and a parked line between."""
    x, x2 = [_hold(0.0, 1.0, fs)], [_hold(0.0, 1.0, fs)]
    total = x[0].size
    while total < n:
        line_hz, lines = float(rng.uniform(2.0, 9.0)), int(rng.integers(12, 30))
        size, low = float(rng.choice([1.0, 0.6, 0.3])), 0.0
        low = float(rng.uniform(0.0, 1.0 - size))
        line = np.r_[_ramp(0, 1, 2 * line_hz, fs), _ramp(1, 0, 2 * line_hz, fs)]
        scan = low + size * np.tile(line, lines)
        go, back = _ramp(0.0, low, 4.0, fs), _ramp(low, 0.0, 4.0, fs)
        slow = np.repeat(np.arange(lines) / lines, line.size) * rng.uniform(0.5, 1.0)
        own = np.concatenate([go, scan, _hold(low, 0.6, fs), back, _hold(0.0, 0.8, fs)])
        other = np.concatenate([np.zeros(go.size), slow, np.full(own.size - go.size - slow.size, slow[-1])])
        # The other axis returns before the next frame, while this one rests.
        other[-round(0.75 * fs) :] = 0.0
        x.append(own)
        x2.append(other)
        total += own.size
    return _filled(x, n), _filled(x2, n)


def multisine(n: int, fs: float, rng: np.random.Generator) -> Array:
    """Random multisines up to a quarter of the sample rate, on ramps between levels, with rests."""
    parts = [_hold(0.0, 1.0, fs)]
    total, at, turn = parts[0].size, 0.0, 0
    while total < n:
        top = float(rng.choice([0.01, 0.1, 0.25])) * fs
        seconds = float(rng.uniform(2.0, 5.0))
        t = np.arange(round(seconds * fs)) / fs
        f = np.round(np.geomspace(0.5, top, 40) * seconds) / seconds
        size = 1.0 / np.sqrt(f)
        wave = (size[:, None] * np.cos(2 * np.pi * f[:, None] * t + rng.uniform(0, 2 * np.pi, 40)[:, None])).sum(axis=0)
        wave *= np.minimum(1.0, np.minimum(t, seconds - t) / 0.1)
        level = float(rng.uniform(0.35, 0.65))
        room = min(level, 1.0 - level)
        wave *= room * (float(rng.choice([0.4, 0.95])) if turn % 3 else 0.95) / np.max(np.abs(wave))
        parts += [_ramp(at, level, 1.5, fs), _hold(level, 0.8, fs), level + wave, _hold(level, 0.6, fs)]
        at = level
        if turn % 3 == 2:
            parts += [_ramp(at, 1.0, 1.0, fs), _hold(1.0, 1.0, fs), _ramp(1.0, 0.0, 1.0, fs), _hold(0.0, 2.0, fs)]
            at = 0.0
        total = sum(part.size for part in parts)
        turn += 1
    return _filled(parts, n)


def _split(n: int, shares: tuple[float, ...]) -> list[int]:
    at = np.round(np.cumsum([0.0, *shares]) / sum(shares) * n).astype(int)
    return [int(b - a) for a, b in itertools.pairwise(at)]


def _closed(x: Array, fs: float) -> Array:
    """The drive with its end brought back to 0 within 0.3 s and a rest of 0.7 s, the length kept."""
    tail, move = round(0.7 * fs), round(0.3 * fs)
    end = x.copy()
    at = end.size - tail - move
    end[at : at + move] = np.linspace(end[at - 1], 0.0, move)
    end[-tail:] = 0.0
    return end


def drive(kind: str, n: int, fs: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """x, x2 (n,) each, between 0 and 1, of one kind in `SHOWS`. ``fs`` in Hz."""
    zero = np.zeros(n)
    match kind:
        case "staircase":
            return _closed(staircase(n, fs, rng), fs), zero
        case "triangles":
            return _closed(triangles(n, fs, rng), fs), zero
        case "raster":
            x, x2 = raster(n, fs, rng)
            return _closed(x, fs), _closed(x2, fs)
        case "multisine":
            return _closed(multisine(n, fs, rng), fs), zero
        case "mixed":
            one, two, three = _split(n, (0.4, 0.35, 0.25))
            x3, other = raster(three, fs, rng)
            parts = [_closed(staircase(one, fs, rng), fs), _closed(triangles(two, fs, rng), fs), _closed(x3, fs)]
            return np.concatenate(parts), np.concatenate([np.zeros(one + two), _closed(other, fs)])
        case "steps_and_sines":
            one, two, three = _split(n, (0.35, 0.45, 0.2))
            t = np.arange(two) / fs
            f = np.repeat(np.geomspace(0.5, 30.0, 8), -(-two // 8))[:two]
            size = np.where(np.arange(two) // max(1, two // 16) % 2 == 0, 0.48, 0.2)
            blocks = np.minimum(1.0, np.minimum(t % (two / fs / 16), (-t) % (two / fs / 16)) / 0.15)
            sines = 0.5 + size * blocks * np.sin(2 * np.pi * np.cumsum(f) / fs)
            sines[: round(0.5 * fs)] = np.linspace(0.0, sines[round(0.5 * fs)], round(0.5 * fs))
            x3 = np.zeros(three)
            t3 = np.arange(three) / fs
            other = 0.5 * (1.0 - np.cos(2 * np.pi * 1.5 * (t3 - 0.5))) * (t3 > 0.5) * (t3 < t3[-1] - 0.9)
            parts = [_closed(staircase(one, fs, rng), fs), _closed(sines, fs), x3]
            return np.concatenate(parts), np.concatenate([np.zeros(one + two), other])
        case "excitation":
            u, u2 = excitation(rng)
            # Its own samples, played at this rate: the levels stay, the frequencies scale.
            x, x2 = np.clip(u / 8.0, 0.0, 1.0)[:n], np.clip(u2 / 8.0, 0.0, 1.0)[:n]
            pad = n - x.size
            return np.pad(x, (0, pad)), np.pad(x2, (0, pad))
    raise ValueError(f"drive: got {kind!r}, expected one of {', '.join(SHOWS)}")


#: Samples and rate of the scaled excitation: its own 65 s at 2 kHz.
EXCITATION_S, EXCITATION_HZ = 65.0, FS_HZ
