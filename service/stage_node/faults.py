"""Faults of a simulated stage on command: wrong readings, samples that are lost, doubled or out of order.

Only a stage started with ``dehyst stage --inject`` accepts them. A fault is JSON on ``.../stage_fault``: ``{"fault":
NAME, "duration_s": 1.0, "value": 0.0}``, or ``{"fault": "change", "values": {"gain_drift.gain": -0.06}}``.
"""

from __future__ import annotations

import json
import math
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray
from dehyst.service.protocol.errors import FieldError
from dehyst.service.protocol.keys import Keys
from dehyst.service.protocol.samples import MAX_SEQ
from dehyst.service.stage_node.exchange import Rows

#: Faults of a reading, and the meaning of ``value``.
READING: Final = {
    "nan": "not used: the reading is not a number",
    "spike": "µm added to every 25th reading",
    "freeze": "not used: the last reading is repeated",
    "saturate": "µm beyond which the reading does not go",
    "offset": "µm added to every reading",
    "stuck_noisy": "µm of noise, rms, about the last reading",
    "sensor_gain": "factor of every motion, from the last reading on",
    "sign": "not used: every motion from the last reading on has the other sign",
    "other_stage": "µm: the readings are those of another stage that moves from 0 to there",
}
#: Faults of a message, and the meaning of ``value``.
DELIVERY: Final = {
    "gap": "not used: nothing is sent",
    "duplicate": "not used: every message is sent twice",
    "reorder": "not used: the messages come in pairs, the later one first",
    "clock": "s added to the time of every sample",
    "seq_jump": "added to the number of one sample",
    "losses": "share of the samples that are not sent, 0 to 1",
    "units": "not used: voltages come in mV and readings in nm",
    "exchanged": "not used: voltages and readings come in each other's place",
    "u_sign": "not used: voltages have the other sign",
}
#: Faults of what a message says, from voltages and readings to those that are sent.
_SAYS: Final[dict[str, Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]]] = {
    "units": lambda u_V, y_um: (1e3 * u_V, 1e3 * y_um),
    "exchanged": lambda u_V, y_um: (y_um, u_V),
    "u_sign": lambda u_V, y_um: (-u_V, y_um),
}
CHANGE: Final = "change"
SPIKE_EVERY: Final = 25
#: Motion of another stage: tones, Hz, their shares of its range, and its noise as a share.
_OTHER_HZ: Final = (0.7, 1.9, 4.3)
_OTHER_SHARES: Final = (0.28, 0.12, 0.06)
_OTHER_NOISE: Final = 1e-4
MAX_DURATION_S: Final = 3600.0
_EXPECTED: Final = 'an object such as {"fault": "nan", "duration_s": 1}'


def sound_key(stage: str, axis: str) -> str:
    """Key on which a stage started with ``--inject`` publishes its samples without any fault."""
    return f"{Keys(stage, axis).base}/stage_sound"


def fault_key(stage: str, axis: str) -> str:
    """Key on which a stage started with ``--inject`` accepts faults."""
    return f"{Keys(stage, axis).base}/stage_fault"


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault: its kind, its length in s, and the ``value`` of its kind; ``values`` for a change."""

    kind: str
    duration_s: float = 0.0
    value: float = 0.0
    values: tuple[tuple[str, float], ...] = ()


def decode_fault(payload: bytes) -> Fault:
    """Decode a fault. Raises InputError that names the field."""
    try:
        data = json.loads(payload)
    except (ValueError, RecursionError) as error:
        raise FieldError("payload", f"no JSON ({error})", _EXPECTED) from None
    if not isinstance(data, dict):
        raise FieldError("payload", repr(data)[:80], _EXPECTED)
    kind = data.get("fault")
    if kind == CHANGE:
        values = data.get("values")
        if not isinstance(values, dict) or not values:
            raise FieldError("values", repr(values)[:80], "parameters of the stage by path, with their new values")
        return Fault(CHANGE, values=tuple((str(name), _number(f"values.{name}", v)) for name, v in values.items()))
    if not isinstance(kind, str) or (kind not in READING and kind not in DELIVERY):
        raise FieldError("fault", repr(kind)[:80], f"one of {', '.join((*READING, *DELIVERY, CHANGE))}")
    duration_s = _number("duration_s", data.get("duration_s"))
    if not 0.0 < duration_s <= MAX_DURATION_S:
        raise FieldError("duration_s", duration_s, f"above 0 and at most {MAX_DURATION_S:g} s")
    return Fault(str(kind), duration_s, _number("value", data.get("value", 0.0)))


def _number(field: str, value: Any) -> float:
    try:
        if not isinstance(value, bool) and isinstance(value, (int, float)) and math.isfinite(value):
            return float(value)
    except OverflowError:  # an integer above the range of doubles
        pass
    raise FieldError(field, repr(value)[:80], "a finite number")


@dataclass(slots=True)
class _Active:
    """A fault that has begun, from sample ``first`` to before ``stop``; the shown and the true reading at its begin."""

    kind: str
    value: float
    first: int
    stop: int
    shown_um: float = math.nan
    true_um: float = math.nan
    done: bool = False


class Injector:
    """The faults of one axis: added by any thread, applied by the loop (readings) and by the sender (messages).

    Parameters
    ----------
    dt_s : sample time, s.
    apply : applies changed parameters to the stage, called by the loop; raises InputError on names and ranges.
    """

    def __init__(self, dt_s: float, apply: Callable[[dict[str, float]], None]) -> None:
        self.counts = dict.fromkeys((*READING, *DELIVERY, CHANGE, "refused"), 0)
        self.error = ""
        self._dt_s = dt_s
        self._apply = apply
        self._lock = threading.Lock()
        self._waiting: list[Fault] = []
        #: Always replaced as a whole, so that the sender reads it without the lock.
        self._active: tuple[_Active, ...] = ()
        self._last_um = 0.0
        self._held: Rows | None = None
        self._rng = np.random.default_rng(0)
        self._loss_rng = np.random.default_rng(1)

    def receive(self, payload: bytes) -> None:
        """Take a message. A malformed one is counted, and the error text of the last one is kept."""
        try:
            self.add(decode_fault(payload))
        except InputError as error:
            self._refuse(error)

    def add(self, fault: Fault) -> None:
        """Apply ``fault`` from the next tick on."""
        with self._lock:
            self._waiting.append(fault)

    def reading(self, k: int, y_um: float) -> float:
        """The reading at tick k, given that of a sound sensor, µm. Called by the loop, tick by tick."""
        if self._waiting:
            self._begin(k)
        for active in self._active:
            if not active.first <= k < active.stop or active.kind not in READING:
                continue
            if k == active.first:
                active.shown_um, active.true_um = self._last_um, y_um
            if active.kind != "spike" or (k - active.first) % SPIKE_EVERY == 0:
                y_um = self._read_um(active, k - active.first, y_um)
                self.counts[active.kind] += 1
        self._last_um = y_um
        return y_um

    def _read_um(self, active: _Active, tick: int, y_um: float) -> float:
        """What a faulty sensor shows of ``y_um``."""
        value, moved_um = active.value, y_um - active.true_um
        match active.kind:
            case "nan":
                return math.nan
            case "freeze":
                return active.shown_um
            case "saturate":
                return min(y_um, value)
            case "stuck_noisy":
                return active.shown_um + value * float(self._rng.standard_normal())
            case "sensor_gain":
                return active.shown_um + value * moved_um
            case "sign":
                return active.shown_um - moved_um
            case "other_stage":
                share = 0.5 + _OTHER_NOISE * float(self._rng.standard_normal())
                for hertz, part in zip(_OTHER_HZ, _OTHER_SHARES, strict=True):
                    share += part * math.sin(2.0 * math.pi * hertz * tick * self._dt_s + hertz)
                return share * value
        return y_um + value

    def deliver(self, rows: Rows) -> list[Rows]:
        """The messages that are sent in place of one message ``rows``. Called by the sender, in order."""
        sent, reordering = [rows], False
        for active in self._active:
            hit = (rows[0] >= active.first) & (rows[0] < active.stop)
            if active.kind in DELIVERY and hit.any():
                self.counts[active.kind] += int(np.count_nonzero(hit))
                reordering = reordering or active.kind == "reorder"
                sent = [message for one in sent for message in self._delivered(active, one)]
        if self._held is not None:
            sent, self._held = [*sent, self._held], None
        elif reordering and len(sent) == 1:
            self._held, sent = sent[0], []
        return [message for message in sent if message[0].size]

    def _delivered(self, active: _Active, rows: Rows) -> list[Rows]:
        """What a fault makes of one message, but for the order."""
        seq, t_s, u_V, y_um = rows
        hit = (seq >= active.first) & (seq < active.stop)
        match active.kind:
            case "gap":
                return [(seq[~hit], t_s[~hit], u_V[~hit], y_um[~hit])]
            case "duplicate":
                return [rows, rows]
            case "clock":
                return [(seq, t_s + active.value * hit, u_V, y_um)]
            case "losses":
                kept = ~hit | (self._loss_rng.uniform(size=hit.size) >= active.value)
                self.counts["losses"] -= int(np.count_nonzero(kept & hit))
                return [(seq[kept], t_s[kept], u_V[kept], y_um[kept])]
            case "seq_jump":
                jumps = hit & (np.cumsum(hit) == 1) & (not active.done)
                self.counts["seq_jump"] -= int(np.count_nonzero(hit & ~jumps))
                active.done = True
                stray = np.minimum(seq + int(active.value), MAX_SEQ)
                return [(np.where(jumps, stray, seq), t_s, u_V, y_um)]
            case kind if kind in _SAYS:
                return [(seq, t_s, *np.where(hit, _SAYS[kind](u_V, y_um), (u_V, y_um)))]
        return [rows]

    def flush(self) -> list[Rows]:
        """The message that is still held back, at the end."""
        held, self._held = self._held, None
        return [] if held is None else [held]

    def _begin(self, k: int) -> None:
        with self._lock:
            waiting, self._waiting = self._waiting, []
        # Keep past faults for a while: the sender may be behind the loop by the length of its ring.
        active = [a for a in self._active if a.stop > k - 65_536]
        for fault in waiting:
            if fault.kind != CHANGE:
                stop = k + max(1, round(fault.duration_s / self._dt_s))
                active.append(_Active(fault.kind, fault.value, k, stop))
                continue
            try:
                self._apply(dict(fault.values))
                self.counts[CHANGE] += 1
            except InputError as error:
                self._refuse(error)
        self._active = tuple(active)

    def _refuse(self, error: InputError) -> None:
        self.counts["refused"] += 1
        self.error = str(error)
