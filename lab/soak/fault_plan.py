"""The faults of a soak: the kinds, the seeded plan, and the schedule that follows the run."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from dehyst.adaptive.errors import InputError

# --- Kinds of faults

#: What a fault acts on: a process, the stage's samples, or the machine.
PROCESS, STAGE, MACHINE = "process", "stage", "machine"


@dataclass(frozen=True, slots=True)
class FaultKind:
    """One kind of fault.

    Attributes
    ----------
    what : description for reports. where : what it acts on.
    duration_s : range of its length, s; the length is drawn from it.
    recover_s : within this time after its end, s, queries must be answered and tracking must be good again.
    silent_s : longest time without an answer that it may cause, s.
    ends_service : whether it ends a service. Such faults come early, so that memory can be measured after them.
    sensor : whether the readings are wrong without being impossible: it must have a name within half a second of
        motion, and the error must stay small.
    """

    what: str
    where: str
    duration_s: tuple[float, float]
    recover_s: float
    silent_s: float = 0.0
    ends_service: bool = False
    sensor: bool = False


FAULT_KINDS: Final[dict[str, FaultKind]] = {
    "kill_primary": FaultKind("kill -9 of the serving process", PROCESS, (0.0, 0.0), 8.0, 0.2, True),
    "stop_primary": FaultKind("SIGSTOP of the serving process", PROCESS, (2.0, 3.0), 8.0, 4.0),
    "kill_standby": FaultKind("kill -9 of the standby", PROCESS, (0.0, 0.0), 8.0, 0.0, True),
    "kill_viewer": FaultKind("kill -9 of the viewer's stream", PROCESS, (0.0, 0.0), 3.0),
    "slow_viewer": FaultKind("a subscriber that takes 50 ms for each message", PROCESS, (2.0, 4.0), 3.0),
    "restart_stage": FaultKind("kill -9 of the stage, and another one counting anew", PROCESS, (0.5, 1.5), 10.0),
    "restart_router": FaultKind("kill -9 of the router, and another one in its place", PROCESS, (0.2, 0.5), 12.0, 8.0),
    "clock_back": FaultKind("the wall clock of the service set back by an hour", MACHINE, (2.0, 4.0), 3.0),
    "disk_full": FaultKind("no more bytes for the recordings", MACHINE, (3.0, 5.0), 10.0),
    "liar": FaultKind("a stranger that answers, publishes and commands beside the service", PROCESS, (2.0, 4.0), 3.0),
    "cpu_stolen": FaultKind("a busy process for each core", MACHINE, (1.5, 3.0), 4.0, 0.5),
    "gap": FaultKind("samples that never come", STAGE, (0.3, 2.0), 5.0),
    "duplicate": FaultKind("every sample twice", STAGE, (0.5, 2.0), 3.0),
    "reorder": FaultKind("messages in the wrong order", STAGE, (0.5, 2.0), 3.0),
    "nan": FaultKind("readings that are not numbers", STAGE, (0.5, 2.0), 5.0),
    "spike": FaultKind("every 25th reading off by 30 µm", STAGE, (0.5, 2.0), 5.0),
    "freeze": FaultKind("a sensor that repeats its last reading", STAGE, (0.5, 2.0), 8.0),
    "saturate": FaultKind("a sensor that ends half way", STAGE, (0.5, 2.0), 8.0),
    "stuck_noisy": FaultKind("a sensor stuck, with 1 pm of noise", STAGE, (2.0, 4.0), 2.0, sensor=True),
    "sensor_gain": FaultKind("a sensor that shows a multiple", STAGE, (2.0, 5.0), 2.0, sensor=True),
    "sign": FaultKind("a sensor with the other sign", STAGE, (2.0, 4.0), 2.0, sensor=True),
    "other_stage": FaultKind("the readings of another stage", STAGE, (2.0, 4.0), 2.0, sensor=True),
    "units": FaultKind("voltages in mV and readings in nm", STAGE, (2.0, 4.0), 2.0, sensor=True),
    "exchanged": FaultKind("voltages and readings exchanged", STAGE, (2.0, 4.0), 2.0, sensor=True),
    "u_sign": FaultKind("voltages with the other sign", STAGE, (2.0, 4.0), 2.0, sensor=True),
    "seq_jump": FaultKind("one sample with a number far ahead", STAGE, (0.5, 0.5), 2.0),
    "losses": FaultKind("19 of 20 samples lost, at random", STAGE, (1.5, 4.0), 3.0),
    "stage_clock": FaultKind("the stage's clock set back by an hour", STAGE, (1.0, 2.0), 5.0),
    "gain": FaultKind("the stage's gain changes by some percent, for good", STAGE, (0.0, 0.0), 12.0),
    "payload": FaultKind("the moved mass doubles, or halves again", STAGE, (0.0, 0.0), 10.0),
}


#: Faults that change a parameter of the stage, and its name.
CHANGES: Final = {"gain": "gain_drift.gain", "payload": "resonance.payload_ratio"}
#: Faults of the readings whose value is a place: the share of the way between the ends of the reference, twice.
_PLACES: Final = {"saturate": 0.5, "other_stage": 1.0}


# --- The plan

#: Time without faults before the first one and at the end, s, and range of the time between two, s.
WARM_S, TAIL_S = 6.0, 3.0
CALM_S = (1.0, 8.0)
#: Time between two faults as a share of the run.
_CALM_SHARE = 1.0 / 180.0
#: Share of the run after which no fault ends a service, so that its memory can be measured.
KILLING_SHARE = 0.4


@dataclass(frozen=True, slots=True)
class PlannedFault:
    """One fault of the plan: begins ``at_s`` after the start and lasts ``duration_s``; the kind defines ``value``."""

    kind: str
    at_s: float
    duration_s: float
    value: float = 0.0

    @property
    def end_s(self) -> float:
        """When it ends, s."""
        return self.at_s + self.duration_s

    @property
    def window_s(self) -> tuple[float, float]:
        """From its beginning to the end of its recovery time, s."""
        return self.at_s, self.end_s + FAULT_KINDS[self.kind].recover_s

    def for_stage(self, low_um: float, high_um: float) -> tuple[str, float]:
        """Name and value of a fault of the samples in the stage's protocol; the ends are those of the reference."""
        name = "clock" if self.kind == "stage_clock" else self.kind
        return name, _PLACES.get(self.kind, 0.0) * (low_um + high_um) or self.value


@dataclass(frozen=True, slots=True)
class SoakPlan:
    """``faults`` in order of time, and in ``left_out`` the kinds that did not fit into the run."""

    duration_s: float
    seed: int
    faults: tuple[PlannedFault, ...]
    left_out: tuple[str, ...]


def select_kinds(names: list[str]) -> tuple[str, ...]:
    """The kinds named, or all if ``names`` is empty; none for ``["none"]``. Raises InputError on an unknown kind."""
    if names == ["none"]:
        return ()
    for name in names:
        if name not in FAULT_KINDS:
            raise InputError(f"--faults: got {name!r}, expected none, or some of: {', '.join(FAULT_KINDS)}")
    return tuple(dict.fromkeys(names)) or tuple(FAULT_KINDS)


def make_plan(duration_s: float, seed: int, kinds: tuple[str, ...]) -> SoakPlan:
    """Draw faults one after the other, each with its time to recover: as many rounds of all kinds as fit into the run.

    The same arguments give the same plan. Kinds that end a service come in the first rounds only.
    """
    rng = np.random.default_rng(seed)
    faults: list[PlannedFault] = []
    at_s = WARM_S
    calm_s = min(max(_CALM_SHARE * duration_s, CALM_S[0]), CALM_S[1])
    done: set[str] = set()
    turn = 0
    while kinds:
        order = [kinds[i] for i in rng.permutation(len(kinds))]
        if turn == 0:
            # The stable sort keeps the drawn order within both groups.
            order.sort(key=lambda name: not FAULT_KINDS[name].ends_service)
        placed = False
        for name in order:
            kind = FAULT_KINDS[name]
            low, high = kind.duration_s
            fault = PlannedFault(name, at_s, round(float(rng.uniform(low, high)), 3), _value(name, rng, turn))
            late = kind.ends_service and turn > 0 and at_s > KILLING_SHARE * duration_s
            if late or fault.window_s[1] > duration_s - TAIL_S:
                continue
            faults.append(fault)
            done.add(name)
            at_s = round(fault.window_s[1] + calm_s, 3)
            placed = True
        turn += 1
        if not placed:
            break
    return SoakPlan(duration_s, seed, tuple(faults), tuple(name for name in kinds if name not in done))


#: Values that a fault has from round to round: noise, µm; factors of the motion; steps of a sample's number.
_TURNS: Final = {
    "stuck_noisy": (1e-6, 1e-3),
    "sensor_gain": (0.01, 3.0, 0.3),
    "seq_jump": (100_000.0, float(2**62)),
}


def _value(name: str, rng: np.random.Generator, turn: int) -> float:
    """The value of a fault. For a change: the new parameter value, which alternates from round to round."""
    if name == "gain":
        return round(float(rng.uniform(-0.06, -0.03)), 4) if turn % 2 == 0 else 0.0
    if name == "payload":
        return 1.0 if turn % 2 == 0 else 0.0
    if name in _TURNS:
        return _TURNS[name][turn % len(_TURNS[name])]
    return {"spike": 30.0, "stage_clock": -3600.0, "clock_back": -3600.0, "losses": 0.95}.get(name, 0.0)


# --- The schedule

#: A delay up to this, s, is absorbed by the time between two faults.
LATE_S: Final = 0.5


class Schedule:
    """The faults of ``plan`` one after the other, each with its time to recover, whatever delays occurred before.

    A fault that starts a process begins when that process is ready, and a fault that is not ``possible`` yet waits;
    those behind it are delayed by as much. A fault that has no time left to recover is left out.
    """

    def __init__(self, plan: SoakPlan, possible: Callable[[PlannedFault], bool]) -> None:
        self._duration_s, self._possible = plan.duration_s, possible
        self._waiting = deque(plan.faults)
        self._delay_s = 0.0
        self._notes: list[str] = []

    def due(self, now_s: float) -> PlannedFault | None:
        """The fault that begins at ``now_s``; None if there is none."""
        while self._waiting and now_s >= self._waiting[0].at_s + self._delay_s:
            fault = self._waiting[0]
            if fault.window_s[1] + self._delay_s <= self._duration_s:
                if self._possible(fault):
                    return self._waiting.popleft()
                self._delay_s = now_s - fault.at_s
                return None
            self._notes.append(_note(self._waiting.popleft(), "no time to recover"))
        return None

    def over(self, fault: PlannedFault, end_s: float) -> None:
        """Report that ``fault`` has ended at ``end_s``."""
        late_s = end_s - (fault.end_s + self._delay_s)
        if late_s > LATE_S:
            self._delay_s += late_s

    def left_out(self) -> list[str]:
        """After the run: one line for each fault that did not happen, with the reason."""
        return self._notes + [_note(fault, "it did not come to it") for fault in self._waiting]


def _note(fault: PlannedFault, why: str) -> str:
    return f"{fault.kind} at {fault.at_s:.0f} s: left out, {why}"
