"""Applies an event from outside the plant: emulated physics, sensor faults, and message faults."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dehyst.adaptive.types import FloatArray
from dehyst.lab.rehearsal.plant import Change, Changeable, Plant, run_checked
from dehyst.service.protocol.errors import FieldError
from dehyst.service.protocol.samples import MAX_SEQ, SampleBatch

# --- The events of a rehearsal: one per run, at a known time, of a known size.
#
# There are two categories. ``INTACT``: stage and sensor work, or the stage has changed and the sensor shows it; the
# error must stay small, and nothing may be reported as a sensor fault. ``SENSOR``: the sensor does not show where the
# stage is; this must be reported, and must not move the stage.

INTACT: Final = "intact"
SENSOR: Final = "sensor"


#: What an event acts on.
NOTHING, PHYSICS, READING, MESSAGE, REFERENCE = "nothing", "physics", "reading", "message", "reference"

#: Draws a number; the second argument is a random sign, 1 or -1.
Draw = Callable[[np.random.Generator, float], float]


def _value(value: float) -> Draw:
    return lambda rng, sign: value


def _uniform(low: float, high: float) -> Draw:
    return lambda rng, sign: float(rng.uniform(low, high))


def _even(low: float, high: float) -> Draw:
    """All decades of the range alike."""
    return lambda rng, sign: float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _signed(draw: Draw) -> Draw:
    return lambda rng, sign: sign * draw(rng, sign)


def _one_of(*values: float) -> Draw:
    return lambda rng, sign: values[int(rng.integers(len(values)))]


def _far_off(rng: np.random.Generator, _sign: float) -> float:
    """A factor well below or well above one."""
    return _even(0.01, 0.5)(rng, 1.0) if rng.uniform() < 0.5 else float(rng.uniform(1.6, 3.0))


class EventKind(NamedTuple):
    """A kind of event.

    category : INTACT or SENSOR. where : what it acts on. text : description. size, over_s : draw ``Event.size`` and
    ``Event.over_s`` where its class does not state them. said : how the size is said, and by what it is multiplied
    first; ``comes`` : it comes within ``over_s`` and stays; else it lasts that long.
    """

    category: str
    where: str
    text: str
    size: Draw = _value(0.0)
    over_s: Draw = _value(0.0)
    said: str = ""
    times: float = 1.0
    comes: bool = False


_BRIEF, _LONG = _uniform(1.0, 3.0), _uniform(2.0, 5.0)
_OF_RANGE: Final = ", {:.3g} % of the range"
#: Jumps of the sample count that are drawn; the largest leaves room for numbers after it.
_JUMPS: Final = (1000.0, 100_000.0, float(2**62 - 2**40))
#: Kinds of events by name. "range" is the commanded range, peak to peak.
EVENT_KINDS: Final[dict[str, EventKind]] = {
    "none": EventKind(INTACT, NOTHING, "nothing happens"),
    "gain": EventKind(
        INTACT, PHYSICS, "the stage's gain changes", _signed(_uniform(0.03, 0.12)), said=" by {:+.3g} %", times=100.0,
        comes=True,
    ),
    "zero": EventKind(
        INTACT, PHYSICS, "the stage's zero shifts", _signed(_uniform(0.01, 0.08)), said=" by {:+.3g} % of the range",
        times=100.0, comes=True,
    ),
    "payload": EventKind(
        INTACT, PHYSICS, "a payload is put on", _uniform(0.3, 2.0), said=", {:.3g} times the moved mass", comes=True
    ),
    "lag": EventKind(
        INTACT, PHYSICS, "the amplifier becomes slower", _even(2e-4, 3e-3), said=" by {:.3g} ms", times=1e3, comes=True
    ),
    "knock": EventKind(
        INTACT, PHYSICS, "somebody touches the table: the stage rings", _even(0.01, 0.05), said=_OF_RANGE, times=100.0
    ),
    "hum": EventKind(INTACT, READING, "mains hum on the reading", _even(5e-4, 0.01), _BRIEF, _OF_RANGE, 100.0),
    "spikes": EventKind(
        INTACT, READING, "single readings are wrong, ten a second", _even(0.005, 1.0), _BRIEF, _OF_RANGE, 100.0
    ),
    "bursts": EventKind(
        INTACT, READING, "readings are wrong for a few ms, three times a second", _even(0.005, 1.0), _BRIEF, _OF_RANGE,
        100.0,
    ),
    "gap": EventKind(INTACT, MESSAGE, "no samples are sent", over_s=_even(0.01, 3.0)),
    "losses": EventKind(
        INTACT, MESSAGE, "samples are lost at random", _uniform(0.3, 0.95), _uniform(1.0, 4.0), ", {:.3g} % of them",
        100.0,
    ),
    "duplicates": EventKind(
        INTACT, MESSAGE, "samples come twice", _uniform(0.2, 1.0), _BRIEF, ", {:.3g} % of them", 100.0
    ),
    "reversed": EventKind(
        INTACT, MESSAGE, "the samples of a message come in reverse order", over_s=_uniform(0.5, 2.0)
    ),
    "number_jump": EventKind(
        INTACT, MESSAGE, "the count of the samples jumps and goes on from there", _one_of(*_JUMPS), said=" by {:.8g}"
    ),
    "number_stray": EventKind(
        INTACT, MESSAGE, "one sample has a number far ahead", _one_of(*_JUMPS[:2], float(2**62)), said=" by {:.8g}"
    ),
    "clock": EventKind(INTACT, MESSAGE, "the stage's clock is set", _signed(_even(0.01, 1e6)), said=" by {:+.3g} s"),
    "rail": EventKind(INTACT, REFERENCE, "the reference asks for more than the stage reaches", over_s=_value(1.0)),
    "stuck": EventKind(SENSOR, READING, "the sensor repeats one reading", over_s=_LONG),
    "stuck_noise": EventKind(
        SENSOR, READING, "the sensor shows one place and noise", _even(1e-9, 3e-5), _LONG, " of {:.1g} of the range"
    ),
    "sensor_gain": EventKind(
        SENSOR, READING, "the sensor shows a multiple of the motion", _far_off, _uniform(2.0, 8.0), " by {:.3g}"
    ),
    "sign": EventKind(SENSOR, READING, "the sensor's sign is flipped", over_s=_LONG),
    "foreign": EventKind(SENSOR, READING, "the readings are those of another stage", over_s=_LONG),
    "units": EventKind(SENSOR, MESSAGE, "voltages come in mV and readings in nm", over_s=_LONG),
    "exchanged": EventKind(SENSOR, MESSAGE, "voltages and readings come in each other's place", over_s=_LONG),
    "u_sign": EventKind(SENSOR, MESSAGE, "the voltages' sign is flipped", over_s=_LONG),
    "u_constant": EventKind(SENSOR, MESSAGE, "the voltage of one sample is repeated", over_s=_LONG),
    "u_late": EventKind(
        SENSOR, MESSAGE, "the voltages are those of earlier samples", _even(0.005, 0.05), _LONG, " by {:.3g} ms", 1e3
    ),
    "u_scaled": EventKind(
        SENSOR, MESSAGE, "the voltages are a multiple of those that were applied",
        lambda rng, sign: float(rng.uniform(1.5, 3.0)) ** sign, _LONG, " by {:.3g}",
    ),
    "other_stage": EventKind(
        SENSOR, MESSAGE, "the samples are those of a like stage that is later by some time", _even(0.2, 1.5), _LONG,
        " by {:.3g} ms", 1e3,
    ),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Event:
    """One event.

    Attributes
    ----------
    name : of its class, under which it is counted. kind : a key of ``EVENT_KINDS``.
    at_s : when it begins, s from the start of the closed loop; at least 2 s.
    size : in the unit of its kind. over_s : time over which a change comes, or for which a fault lasts, s.
    seed : of its random parts.

    Raises FieldError on values out of range.
    """

    name: str
    kind: str
    at_s: float
    size: float = 0.0
    over_s: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        if self.kind not in EVENT_KINDS:
            raise FieldError("event.kind", repr(self.kind), f"one of {', '.join(EVENT_KINDS)}")
        if not 2.0 <= self.at_s <= 1e5:
            raise FieldError("event.at_s", f"{self.at_s:g} s", "2 s or later: what was before is compared with it")
        if not (np.isfinite(self.size) and 0.0 <= self.over_s <= 1e5):
            raise FieldError("event.size, over_s", f"{self.size}, {self.over_s}", "a finite size, and 0 s or more")
        if self.seed < 0:
            raise FieldError("event.seed", self.seed, "an integer from 0 on")

    @property
    def category(self) -> str:
        """INTACT or SENSOR."""
        return EVENT_KINDS[self.kind].category

    @property
    def where(self) -> str:
        """What it acts on."""
        return EVENT_KINDS[self.kind].where

    @property
    def end_s(self) -> float:
        """When the change is complete or the fault has ended, s from the start."""
        return self.at_s + self.over_s

    @property
    def text(self) -> str:
        """Description with size and duration."""
        kind = EVENT_KINDS[self.kind]
        how = f", for {self.over_s:.2g} s" if self.over_s else ""
        if kind.comes:
            how = f", within {self.over_s:g} s" if self.over_s else ", at once"
        return kind.text + kind.said.format(kind.times * self.size) + how


#: How physical changes come: suffix of the name, and time over which they come, s.
_RAMPS: Final = (("at_once", 0.0), ("fast", 0.2), ("slow", 10.0))
#: Classes of events: name → (kind, time over which it comes, s; None: drawn).
CLASSES: Final[dict[str, tuple[str, float | None]]] = {
    "none": ("none", 0.0),
    **{
        f"{name}_{how}": (name, over_s)
        for name, kind in EVENT_KINDS.items() if kind.comes
        for how, over_s in _RAMPS
    },
    **{name: (name, None) for name, kind in EVENT_KINDS.items() if name != "none" and not kind.comes},
}  # fmt: skip
#: The classes of a rehearsal by default: one of each sort, some seconds each.
STANDARD: Final = (
    "none", "gain_at_once", "gain_fast", "zero_at_once", "payload_at_once", "lag_fast", "knock", "hum", "spikes",
    "bursts", "gap", "losses", "number_jump", "number_stray", "clock", "rail", "stuck", "stuck_noise", "sensor_gain",
    "sign", "foreign",
)  # fmt: skip


def draw(name: str, seed: int, at_s: float) -> Event:
    """Draw an event of the class ``name`` (a key of ``CLASSES``): its size and length depend on ``seed``.

    Raises FieldError on an unknown name.
    """
    if name not in CLASSES:
        raise FieldError("events", repr(name), f"some of {', '.join(CLASSES)}")
    kind, over_s = CLASSES[name]
    rng = np.random.default_rng([seed, list(CLASSES).index(name)])
    sign, own_seed = float(rng.choice([-1.0, 1.0])), int(rng.integers(2**31))
    drawn = EVENT_KINDS[kind]
    size = drawn.size(rng, sign)
    return Event(name, kind, at_s, size, drawn.over_s(rng, sign) if over_s is None else over_s, own_seed)


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
        self._ring_Hz = math.exp(rng.uniform(math.log(min(KNOCK_HZ[0], highest)), math.log(highest)))
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
        #: (2, ticks) voltages, V, and readings, µm, so far: samples that come later are taken from them.
        self._past = np.zeros((2, 0))

    def carry(self, first: int, u_V: FloatArray, read_um: FloatArray) -> Message | None:
        """The message with the (n,) samples from ``first`` on, or None if none arrives."""
        tick = np.arange(first, first + u_V.size, dtype=np.int64)
        seq = tick + self._number
        t_s: FloatArray = seq.astype(np.float64) * self._dt_s
        order = np.arange(u_V.size)
        kind = self._event.kind if self._acts else ""
        mixes_up = self._acts and self._event.category == SENSOR
        if mixes_up:
            self._past = np.concatenate([self._past, (u_V, read_um)], axis=1)
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
            elif mixes_up:
                u_V, read_um = np.where(inside, self._mixed_up(kind, tick), (u_V, read_um))
        if not order.size:
            return None
        return Message(tick[order], SampleBatch(seq[order], t_s[order], u_V[order], read_um[order]))

    def _mixed_up(self, kind: str, tick: NDArray[np.int64]) -> FloatArray:
        """(2, n) voltages and readings of ``tick`` as a sender gives them that takes one thing for another."""
        n = tick.size
        u_V, read_um = now = self._past[:, -n:]
        if kind == "units":
            return 1e3 * now
        if kind == "exchanged":
            return now[::-1]
        if kind == "u_sign":
            return np.stack([-u_V, read_um])
        if kind == "u_scaled":
            return np.stack([self._event.size * u_V, read_um])
        # The column of each sample that is sent in the place of this one: the first of the event, or an earlier one.
        shown = np.arange(self._past.shape[1] - n, self._past.shape[1])
        then = shown - (tick - self._first if kind == "u_constant" else round(self._event.size / self._dt_s))
        earlier = self._past[:, np.maximum(then, 0)]
        return earlier if kind == "other_stage" else np.stack([earlier[0], read_um])
