"""The diagnosis on measured records into which one known effect was put: ``python -m benchmarks.injections``.

Each case takes a measured record of ``RECORDS`` and an effect of `tests.foreign.inject`, of a random size that adds 2
to 20 times the record's floor beyond a gain and an offset, and diagnoses the record untouched and injected.

named : a cause, or its set, holds the effect; one that the untouched record has as well must hold the sum of both.
others : all other names are those of the untouched record. covers : the 95 % interval holds the size (that of the
untouched record added), where the diagnosis gives that number. clear : "adequate" in spite of the effect.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from benchmarks.measured import Source, data_folder, multisine
from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray
from dehyst.sim.diagnosis import diagnose_prepared, prepare
from dehyst.sim.recordings import Recording
from tests.foreign.inject import ACCEPTED, beyond, inject, lagged


@dataclass(frozen=True)
class Record:
    """A part of a measured file, s. ``floor_um``: RMS that a diagnosis leaves of it untouched.

    nominal : the stage that it is compared with. others : of further drives.
    """

    source: Source
    begin_s: float
    end_s: float
    floor_um: float
    nominal: str = "bouc_wen"
    others: tuple[Source, ...] = ()

    def read(self, folder: Path) -> tuple[float, FloatArray, FloatArray, list[FloatArray]]:
        """Sample time (s), voltage, displacement and voltages of other drives, (n,) each; gaps are filled."""
        whole = self.source.read(folder)
        dt_s, u, y = whole.dt_s, whole.u_V, whole.y_um
        more = [source.read(folder).u_V for source in self.others]
        part = slice(round(self.begin_s / dt_s), round(self.end_s / dt_s))
        u, y = (_filled(column[part]) for column in (u, y))
        return dt_s, u, y, [column[part] for column in more]


def _filled(x: FloatArray) -> FloatArray:
    known, at = np.isfinite(x), np.arange(x.size)
    return np.interp(at, at[known], x[known])


def _mirror(level: int, channel: int, floor_um: float) -> Record:
    source, *others = (multisine(f"{level}mV_train", c, 0) for c in sorted(range(3), key=lambda c: c != channel))
    return Record(source, 0.0, 2.56, floor_um, "linear", tuple(others))


_SINE, _RAMPED = Source("picma_stack/model_sine_1hz.csv"), Source("picma_stack/test_ramped_sine_ff.csv")
RECORDS: dict[str, Record] = {
    "stack, 1 Hz": Record(_SINE, 0.0, 20.0, 0.085),
    "stack, 1 Hz, later": Record(_SINE, 20.0, 40.0, 0.085),
    "stack, ramped": Record(_RAMPED, 5.0, 25.0, 0.08),
    "stack, ramped, later": Record(_RAMPED, 30.0, 50.0, 0.11),
    "mirror, 100 mV": _mirror(100, 0, 0.58),
    "mirror, 200 mV": _mirror(200, 0, 0.83),
    "damper, 1 Hz": Record(Source("measured/friction-damper-1Hz.parquet"), 0.0, 7.0, 1300.0),
    "damper, earthquake": Record(Source("measured/friction-damper-earthquake.parquet"), 10.0, 27.0, 1300.0),
    "circuit": Record(Source("measured/silverbox.parquet"), 0.0, 20.0, 9e-4),
}


@dataclass(frozen=True)
class Answer:
    """What the diagnosis says: each cause with its alternatives, its numbers and their intervals."""

    verdict: str
    names: list[list[str]] = field(default_factory=list)
    numbers: list[dict[str, float]] = field(default_factory=list)
    intervals: list[dict[str, tuple[float, float]]] = field(default_factory=list)
    seconds: float = 0.0

    def of(self, accepted: Sequence[str]) -> int | None:
        """Index of the first cause whose set holds one of ``accepted``."""
        return next((i for i, group in enumerate(self.names) if set(group) & set(accepted)), None)


def ask(record: Record, dt_s: float, u_V: FloatArray, y_um: FloatArray, more: list[FloatArray]) -> Answer:
    """The diagnosis of one record; a refusal is a verdict of its own."""
    other = {f"u{i + 2}_V": column[: u_V.size] for i, column in enumerate(more)}
    start = time.perf_counter()
    try:
        recording = Recording(t_s=np.arange(u_V.size) * dt_s, u_V=u_V, y_um=y_um, dt_s=dt_s, **other)
        said = diagnose_prepared(prepare(recording, nominal=record.nominal))
    except InputError:
        return Answer("refused", seconds=time.perf_counter() - start)
    names = [[c.name, *c.alternatives] for c in said.causes]
    numbers, intervals = [c.parameters for c in said.causes], [c.intervals for c in said.causes]
    return Answer(said.verdict, names, numbers, intervals, time.perf_counter() - start)


@dataclass(frozen=True)
class Case:
    """One injected record, the answers, and their judgement."""

    record: str
    cause: str
    truth: dict[str, float]
    floors: float
    untouched: Answer
    answer: Answer
    named: bool
    others: bool
    covers: bool | None

    def __str__(self) -> str:
        numbers = ", ".join(f"{k} {v:.4g}" for k, v in self.truth.items())
        before, after = ("; ".join(map(" or ".join, a.names)) or "nothing" for a in (self.untouched, self.answer))
        word = "right" if self.named and self.others else "named" if self.named else "MISSED"
        return (
            f"{word}: {self.cause} ({numbers}; {self.floors:.1f} floors) in {self.record}: {self.answer.verdict}: "
            f"{after} (untouched: {before}; {self.answer.seconds:.0f} s)"
        )


def judge(
    record: str, cause: str, truth: dict[str, float], floors: float, before: Answer, after: Answer
) -> Case | None:
    """The judgement of an answer; None where the untouched record has the cause without a number to compare."""
    accepted = ACCEPTED[cause]
    at, was = after.of(accepted), before.of(accepted)
    covers: bool | None = None
    if at is not None:
        shown = after.intervals[at]
        base = {} if was is None else before.numbers[was]
        # Another cause of one set has other numbers: those of the two records cannot be compared then.
        both = [k for k in truth if k in shown and (was is None or k in base)]
        inside = [shown[k][0] <= truth[k] + base.get(k, 0.0) <= shown[k][1] for k in both]
        covers = all(inside) if inside else None
    if was is not None and at is not None and covers is None:
        return None
    rest = [set(group) for i, group in enumerate(after.names) if i != at]
    base_rest = [set(group) for i, group in enumerate(before.names) if i != was]
    same = len(rest) == len(base_rest) and all(any(a & b for b in rest) for a in base_rest)
    named = at is not None and (was is None or covers is True)
    return Case(record, cause, truth, floors, before, after, named, same, covers)


def run(records: Sequence[str], causes: Sequence[str], seed: int, count: int, out: Path | None) -> list[Case]:
    """Draw and diagnose ``count`` cases, causes and records in turn, both in random order."""
    rng = np.random.default_rng(seed)
    untouched: dict[str, Answer] = {}
    cases: list[Case] = []
    order: list[str] = []
    for number in range(count):
        order = order or [str(c) for c in rng.permutation(causes)]
        cause = order.pop()
        own = np.random.default_rng([seed, number])
        drawn = None
        for _ in range(200):
            name = str(own.choice(records))
            dt_s, u, y, more = RECORDS[name].read(data_folder())
            u2, y2, truth = inject(dt_s, u, y, cause, own)
            seen = lagged(y, truth["tau_s"], dt_s) if cause == "amplifier_lag" else y2
            floors = beyond(y[: seen.size], seen) / RECORDS[name].floor_um
            if 2.0 <= floors <= 20.0:
                drawn = name
                break
        if drawn is None:
            continue
        if drawn not in untouched:
            untouched[drawn] = ask(RECORDS[drawn], dt_s, u, y, more)
        case = judge(drawn, cause, truth, floors, untouched[drawn], ask(RECORDS[drawn], dt_s, u2, y2, more))
        if case is None:
            continue
        cases.append(case)
        print(f"[{number + 1}/{count}] {case}", file=sys.stderr, flush=True)
        if out is not None:
            out.write_text(json.dumps([asdict(c) for c in cases], indent=1))
    return cases


def table(cases: list[Case]) -> str:
    """Rates by cause and in all, and the time."""
    head = "| injected | named | others the same | right | covers | false all-clear or refusal |"
    lines = [head, "|---|---|---|---|---|---|"]
    for cause in (*dict.fromkeys(sorted(c.cause for c in cases)), "all"):
        own = [c for c in cases if cause in (c.cause, "all")]
        spans = [c.covers for c in own if c.covers is not None]
        wrong = sum(c.answer.verdict in ("adequate", "refused") for c in own)
        named, others = sum(c.named for c in own), sum(c.others for c in own)
        right = sum(c.named and c.others for c in own)
        n = len(own)
        lines.append(
            f"| {cause} | {named} of {n} | {others} of {n} | {right} of {n} | {sum(spans)} of {len(spans)} | {wrong} |"
        )
    seconds = [c.answer.seconds for c in cases]
    return "\n".join([*lines, f"\n{np.median(seconds):.0f} s median, {max(seconds):.0f} s worst."])


def main(argv: list[str] | None = None) -> None:
    """Run the cases and print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.injections", description=__doc__)
    parser.add_argument("--records", nargs="+", choices=RECORDS, default=list(RECORDS))
    parser.add_argument("--causes", nargs="+", choices=ACCEPTED, default=list(ACCEPTED))
    parser.add_argument("--count", type=int, default=30)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every case there, after each one")
    args = parser.parse_args(argv)
    print(table(run(args.records, args.causes, args.seed, args.count, args.json)))


if __name__ == "__main__":
    main()
