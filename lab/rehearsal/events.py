"""The events of a rehearsal: one per run, at a known time, of a known size.

There are two categories. ``INTACT``: stage and sensor work, or the stage has changed and the sensor shows it; the
error must stay small, and nothing may be reported as a sensor fault. ``SENSOR``: the sensor does not show where the
stage is; this must be reported, and must not move the stage.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from service.protocol.errors import FieldError

INTACT: Final = "intact"
SENSOR: Final = "sensor"


class EventKind(NamedTuple):
    """A kind of event. category : INTACT or SENSOR. where : what it acts on. unit : of ``Event.size``. text :
    description."""

    category: str
    where: str
    unit: str
    text: str


#: What an event acts on.
NOTHING, PHYSICS, READING, MESSAGE, REFERENCE = "nothing", "physics", "reading", "message", "reference"

#: Kinds of events by name. "range" is the commanded range, peak to peak.
EVENT_KINDS: Final[dict[str, EventKind]] = {
    "none": EventKind(INTACT, NOTHING, "", "nothing happens"),
    "gain": EventKind(INTACT, PHYSICS, "share of the gain", "the stage's gain changes"),
    "zero": EventKind(INTACT, PHYSICS, "share of the range", "the stage's zero shifts"),
    "payload": EventKind(INTACT, PHYSICS, "share of the moved mass", "a payload is put on"),
    "lag": EventKind(INTACT, PHYSICS, "s", "the amplifier becomes slower"),
    "knock": EventKind(INTACT, PHYSICS, "share of the range", "somebody touches the table: the stage rings"),
    "hum": EventKind(INTACT, READING, "share of the range", "mains hum on the reading"),
    "spikes": EventKind(INTACT, READING, "share of the range", "single readings are wrong, ten a second"),
    "bursts": EventKind(INTACT, READING, "share of the range", "readings are wrong for a few ms, three times a second"),
    "gap": EventKind(INTACT, MESSAGE, "", "no samples are sent"),
    "losses": EventKind(INTACT, MESSAGE, "share of the samples", "samples are lost at random"),
    "duplicates": EventKind(INTACT, MESSAGE, "share of the samples", "samples come twice"),
    "reversed": EventKind(INTACT, MESSAGE, "", "the samples of a message come in reverse order"),
    "number_jump": EventKind(INTACT, MESSAGE, "numbers", "the count of the samples jumps and goes on from there"),
    "number_stray": EventKind(INTACT, MESSAGE, "numbers", "one sample has a number far ahead"),
    "clock": EventKind(INTACT, MESSAGE, "s", "the stage's clock is set"),
    "rail": EventKind(INTACT, REFERENCE, "", "the reference asks for more than the stage reaches"),
    "stuck": EventKind(SENSOR, READING, "", "the sensor repeats one reading"),
    "stuck_noise": EventKind(SENSOR, READING, "share of the range, rms", "the sensor shows one place and noise"),
    "sensor_gain": EventKind(SENSOR, READING, "factor", "the sensor shows a multiple of the motion"),
    "sign": EventKind(SENSOR, READING, "", "the sensor's sign is flipped"),
    "foreign": EventKind(SENSOR, READING, "", "the readings are those of another stage"),
}


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
        return f"{EVENT_KINDS[self.kind].text}{_sized(self)}{_when(self)}"


def _sized(event: Event) -> str:
    kind, size = event.kind, event.size
    if kind in ("gain", "zero"):
        return f" by {100.0 * size:+.3g} %" + (" of the range" if kind == "zero" else "")
    if kind in ("knock", "hum", "spikes", "bursts"):
        return f", {100.0 * size:.3g} % of the range"
    if kind == "payload":
        return f", {size:.3g} times the moved mass"
    if kind == "lag":
        return f" by {1e3 * size:.3g} ms"
    if kind == "stuck_noise":
        return f" of {size:.1g} of the range"
    if kind == "sensor_gain":
        return f" by {size:.3g}"
    if kind in ("losses", "duplicates"):
        return f", {100.0 * size:.3g} % of them"
    if kind in ("number_jump", "number_stray"):
        return f" by {size:.8g}"
    return f" by {size:+.3g} s" if kind == "clock" else ""


def _when(event: Event) -> str:
    if event.kind in ("gain", "zero", "payload", "lag"):
        return f", within {event.over_s:g} s" if event.over_s else ", at once"
    return f", for {event.over_s:.2g} s" if event.over_s else ""


#: How physical changes come: suffix of the name, and time over which they come, s.
_RAMPS: Final = (("at_once", 0.0), ("fast", 0.2), ("slow", 10.0))
#: Classes of events: name → (kind, time over which it comes, s; None: drawn).
CLASSES: Final[dict[str, tuple[str, float | None]]] = {
    "none": ("none", 0.0),
    **{f"{kind}_{how}": (kind, over) for kind in ("gain", "zero", "payload", "lag") for how, over in _RAMPS},
    **{
        kind: (kind, None)
        for kind in (
            "knock", "hum", "spikes", "bursts", "gap", "losses", "duplicates", "reversed", "number_jump",
            "number_stray", "clock", "rail", "stuck", "stuck_noise", "sensor_gain", "sign", "foreign",
        )
    },
}  # fmt: skip
#: The classes of a rehearsal by default: one of each sort, some seconds each.
STANDARD: Final = (
    "none", "gain_at_once", "gain_fast", "zero_at_once", "payload_at_once", "lag_fast", "knock", "hum", "spikes",
    "bursts", "gap", "losses", "number_jump", "number_stray", "clock", "rail", "stuck", "stuck_noise", "sensor_gain",
    "sign", "foreign",
)  # fmt: skip
#: Jumps of the sample count that are drawn; the largest leaves room for numbers after it.
_JUMPS: Final = (1000.0, 100_000.0, float(2**62 - 2**40))


def draw(name: str, seed: int, at_s: float) -> Event:
    """Draw an event of the class ``name`` (a key of ``CLASSES``): its size and length depend on ``seed``.

    Raises FieldError on an unknown name.
    """
    if name not in CLASSES:
        raise FieldError("events", repr(name), f"some of {', '.join(CLASSES)}")
    kind, over_s = CLASSES[name]
    rng = np.random.default_rng([seed, list(CLASSES).index(name)])
    sign = float(rng.choice([-1.0, 1.0]))
    event = Event(name, kind, at_s, 0.0, 0.0 if over_s is None else over_s, int(rng.integers(2**31)))

    def between(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    if kind == "gain":
        return replace(event, size=sign * rng.uniform(0.03, 0.12))
    if kind == "zero":
        return replace(event, size=sign * rng.uniform(0.01, 0.08))
    if kind == "payload":
        return replace(event, size=float(rng.uniform(0.3, 2.0)))
    if kind == "lag":
        return replace(event, size=between(2e-4, 3e-3))
    if kind == "knock":
        return replace(event, size=between(0.01, 0.05))
    if kind == "hum":
        return replace(event, size=between(5e-4, 0.01), over_s=float(rng.uniform(1.0, 3.0)))
    if kind in ("spikes", "bursts"):
        return replace(event, size=between(0.005, 1.0), over_s=float(rng.uniform(1.0, 3.0)))
    if kind == "gap":
        return replace(event, over_s=between(0.01, 3.0))
    if kind == "losses":
        return replace(event, size=float(rng.uniform(0.3, 0.95)), over_s=float(rng.uniform(1.0, 4.0)))
    if kind == "duplicates":
        return replace(event, size=float(rng.uniform(0.2, 1.0)), over_s=float(rng.uniform(1.0, 3.0)))
    if kind == "reversed":
        return replace(event, over_s=float(rng.uniform(0.5, 2.0)))
    if kind == "number_jump":
        return replace(event, size=_JUMPS[int(rng.integers(3))])
    if kind == "number_stray":
        return replace(event, size=(1000.0, 100_000.0, float(2**62))[int(rng.integers(3))])
    if kind == "clock":
        return replace(event, size=sign * between(0.01, 1e6))
    if kind == "rail":
        return replace(event, over_s=1.0)
    if kind == "stuck_noise":
        return replace(event, size=between(1e-9, 3e-5), over_s=float(rng.uniform(2.0, 5.0)))
    if kind == "sensor_gain":
        size = between(0.01, 0.5) if rng.uniform() < 0.5 else float(rng.uniform(1.6, 3.0))
        return replace(event, size=size, over_s=float(rng.uniform(2.0, 8.0)))
    if kind in ("stuck", "sign", "foreign"):
        return replace(event, over_s=float(rng.uniform(2.0, 5.0)))
    return event
