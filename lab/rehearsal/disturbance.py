"""Applies an event from outside the plant: emulated physics, sensor faults, and message faults."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adaptive.types import FloatArray
from lab.rehearsal.events import MESSAGE, PHYSICS, READING, Event
from lab.rehearsal.plant import Change, Changeable, Plant, run_checked
from service.protocol.samples import MAX_SEQ, SampleBatch

#: Ringing after an emulated knock: ranges of its frequency, Hz, and its damping ratio.
KNOCK_HZ, KNOCK_DAMPING = (100.0, 1000.0), (0.01, 0.05)
#: Rate of wrong single readings and of wrong bursts, per second; range of the length of a burst, s.
SPIKES_HZ, BURSTS_HZ = 10.0, 3.0
BURST_S = (0.002, 0.008)


@dataclass(frozen=True, slots=True)
class EventScale:
    """What the size of an event refers to: the commanded range, its middle, and the displacement at rest, µm."""

    range_um: float
    middle_um: float
    rest_um: float


class DisturbedPlant:
    """A plant with the physics of an event: applied by the plant itself if it can, else emulated from outside.

    Attributes
    ----------
    left_out : why the event did not happen; empty if it does.
    """

    def __init__(self, plant: Plant, event: Event, scale: EventScale) -> None:
        self._plant, self._event, self._scale = plant, event, scale
        self._dt_s = plant.dt_s
        self._at = round(event.at_s / plant.dt_s)
        self._emulated = False
        self._lagged_V = math.nan
        rng = np.random.default_rng(event.seed)
        highest = min(KNOCK_HZ[1], 0.4 / plant.dt_s)
        self._ring_Hz = math.exp(rng.uniform(math.log(KNOCK_HZ[0]), math.log(highest)))
        self._ring_damping = rng.uniform(*KNOCK_DAMPING)
        self.left_out = ""

    def run(self, first: int, u_V: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n,) true displacement and reading, µm, for the samples from ``first`` on. Raises what the plant raises."""
        cut = self._at - first
        if self._event.where == PHYSICS and 0 <= cut < u_V.size:
            before = self._run(first, u_V[:cut]) if cut else (np.empty(0), np.empty(0))
            self._begin()
            after = self._run(self._at, u_V[cut:])
            return np.concatenate([before[0], after[0]]), np.concatenate([before[1], after[1]])
        return self._run(first, u_V)

    def _begin(self) -> None:
        event, plant = self._event, self._plant
        size = event.size * (self._scale.range_um if event.kind in ("zero", "knock") else 1.0)
        taken = isinstance(plant, Changeable) and plant.change(Change(event.kind, size, event.over_s, event.seed))
        self._emulated = not taken
        if self._emulated and event.kind == "payload":
            self.left_out = "the plant takes no payload, and none can be emulated from outside"

    def _run(self, first: int, u_V: FloatArray) -> tuple[FloatArray, FloatArray]:
        if not self._emulated:
            return run_checked(self._plant, u_V)
        event, scale = self._event, self._scale
        passed_s = (np.arange(first, first + u_V.size, dtype=np.float64) - self._at) * self._dt_s
        grown = np.minimum(1.0, passed_s / event.over_s) if event.over_s else np.ones(u_V.size)
        if event.kind == "lag":
            u_V = self._slowed(u_V, event.size * grown)
        true_um, read_um = run_checked(self._plant, u_V)
        if event.kind == "gain":
            added = event.size * grown * (true_um - scale.rest_um)
        elif event.kind == "zero":
            added = event.size * scale.range_um * grown
        elif event.kind == "knock":
            omega = 2.0 * math.pi * self._ring_Hz
            added = (
                event.size * scale.range_um * np.exp(-self._ring_damping * omega * passed_s) * np.sin(omega * passed_s)
            )
        else:
            return true_um, read_um
        return true_um + added, read_um + added

    def _slowed(self, u_V: FloatArray, lag_s: FloatArray) -> FloatArray:
        """(n,) voltages, V, after a first-order lag with (n,) time constants, s."""
        slow = np.empty_like(u_V)
        now = self._lagged_V if math.isfinite(self._lagged_V) else float(u_V[0])
        for k, (u, tau) in enumerate(zip(u_V.tolist(), lag_s.tolist(), strict=True)):
            now += (u - now) * (1.0 - math.exp(-self._dt_s / tau) if tau > 0.0 else 1.0)
            slow[k] = now
        self._lagged_V = now
        return slow


class DisturbedSensor:
    """The readings that arrive, under an event that acts on readings."""

    def __init__(self, event: Event, scale: EventScale, dt_s: float, n: int) -> None:
        self._event, self._scale, self._dt_s = event, scale, dt_s
        self._first, self._last = round(event.at_s / dt_s), round(event.end_s / dt_s)
        self._held_um = math.nan
        self._acts = event.where == READING
        rng = np.random.default_rng(event.seed)
        self._about_um = scale.middle_um if rng.integers(2) else scale.rest_um
        t_s: FloatArray = (np.arange(n, dtype=np.float64) - self._first) * dt_s
        inside = (t_s >= 0.0) & (np.arange(n) < self._last)
        #: (n,) µm: added to the reading or in place of it, depending on the kind of event.
        self._values_um = np.zeros(n)
        if self._acts:
            self._values_um = np.where(inside, self._drawn(event, t_s, rng), 0.0)

    def _drawn(self, event: Event, t_s: FloatArray, rng: np.random.Generator) -> FloatArray:
        size_um, n = event.size * self._scale.range_um, t_s.size
        if event.kind == "hum":
            hertz = float(rng.choice([50.0, 60.0]))
            return np.asarray(size_um * np.sin(2.0 * math.pi * hertz * t_s))
        if event.kind in ("spikes", "bursts"):
            rate = (SPIKES_HZ if event.kind == "spikes" else BURSTS_HZ) * self._dt_s
            values = np.zeros(n)
            for k in np.flatnonzero(rng.uniform(size=n) < rate).tolist():
                # At least one sample, even if a sample is longer than a burst.
                length = 1 if event.kind == "spikes" else max(1, round(rng.uniform(*BURST_S) / self._dt_s))
                values[k : k + length] = size_um * rng.uniform(0.2, 1.0) * rng.choice([-1.0, 1.0])
            return values
        if event.kind == "stuck_noise":
            return np.asarray(size_um * rng.standard_normal(n))
        if event.kind == "foreign":
            # Another stage with its own motion: tones at another place.
            tones_Hz, phase = np.exp(rng.uniform(math.log(0.3), math.log(6.0), 4)), rng.uniform(0.0, 6.3, 4)
            weight = rng.uniform(0.5, 1.0, 4) / np.sqrt(tones_Hz)
            wave = np.sin(2.0 * math.pi * np.multiply.outer(t_s, tones_Hz) + phase) @ (weight / weight.sum())
            half = 0.5 * self._scale.range_um * rng.uniform(0.5, 1.2)
            noise = 1e-4 * self._scale.range_um * rng.standard_normal(n)
            return np.asarray(self._scale.middle_um + 0.3 * half * rng.uniform(-1.0, 1.0) + half * wave + noise)
        return np.zeros(n)

    def read(self, first: int, read_um: FloatArray) -> FloatArray:
        """(n,) readings, µm, as they arrive, from those of the plant's sensor for the samples from ``first`` on."""
        part = slice(max(0, self._first - first), max(0, self._last - first))
        if not self._acts or part.start >= min(part.stop, read_um.size):
            return read_um
        got = read_um.copy()
        now, drawn_um = got[part], self._values_um[first : first + read_um.size][part]
        if self._event.kind in ("hum", "spikes", "bursts"):
            got[part] = now + drawn_um
        elif self._event.kind in ("stuck", "stuck_noise"):
            if math.isnan(self._held_um):
                self._held_um = float(now[0])
            got[part] = self._held_um + drawn_um
        elif self._event.kind == "sensor_gain":
            got[part] = self._scale.rest_um + self._event.size * (now - self._scale.rest_um)
        elif self._event.kind == "sign":
            got[part] = 2.0 * self._about_um - now
        elif self._event.kind == "foreign":
            got[part] = drawn_um
        return got


@dataclass(frozen=True, slots=True)
class Message:
    """The samples of a block as they arrive: (m,) ``tick`` of each, and the message."""

    tick: NDArray[np.int64]
    batch: SampleBatch


class MessageLine:
    """Carries the messages, under an event that acts on messages.

    ``first_number``: number of sample 0 in the stage's count; samples before it have numbers down to 0.
    """

    def __init__(self, event: Event, dt_s: float, first_number: int) -> None:
        self._event, self._dt_s, self._number = event, dt_s, first_number
        self._first = round(event.at_s / dt_s)
        self._last = max(self._first + 1, round(event.end_s / dt_s))
        self._acts = event.where == MESSAGE
        self._rng = np.random.default_rng(event.seed)

    def carry(self, first: int, u_V: FloatArray, read_um: FloatArray) -> Message | None:
        """The message with the (n,) samples from ``first`` on, or None if none arrives."""
        tick = np.arange(first, first + u_V.size, dtype=np.int64)
        seq = tick + self._number
        t_s: FloatArray = seq.astype(np.float64) * self._dt_s
        order = np.arange(u_V.size)
        kind = self._event.kind if self._acts else ""
        inside = (tick >= self._first) & (tick < self._last)
        if kind == "number_jump":
            # A multiple of 1000, so that snapshots still fall on the same samples of a block.
            seq = seq + np.where(tick >= self._first, int(self._event.size) // 1000 * 1000, 0)
        elif kind == "number_stray":
            stray = np.minimum(seq + int(self._event.size), MAX_SEQ)
            seq = np.where(tick == self._first, stray, seq)
        elif kind == "clock":
            t_s = t_s + np.where(tick >= self._first, self._event.size, 0.0)
        elif inside.any():
            if kind == "gap":
                order = order[~inside]
            elif kind == "losses":
                order = order[~inside | (self._rng.uniform(size=order.size) >= self._event.size)]
            elif kind == "duplicates":
                order = np.repeat(order, 1 + (inside & (self._rng.uniform(size=order.size) < self._event.size)))
            elif kind == "reversed":
                order = order[::-1]
        if not order.size:
            return None
        return Message(tick[order], SampleBatch(seq[order], t_s[order], u_V[order], read_um[order]))
