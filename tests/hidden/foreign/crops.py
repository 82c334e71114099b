"""Does the answer depend on the crop? Six crops of each record, ``python -m tests.hidden.foreign.crops --records 20``.

Two answers contradict each other if each names a cause that the other does not name: neither is then a part of the
other. A cause with its alternatives is one set, and two sets that share a name agree. Records have one or two hidden
causes in turn, on all generators.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from itertools import combinations

from dehyst.adaptive.errors import InputError
from dehyst.sim.diagnosis import diagnose_prepared, prepare
from tests.hidden.foreign.score import KINDS, named_in, nominal_of, recording_of

#: Parts of a record, as shares of its length.
CROPS = ((0.0, 1.0), (0.0, 0.5), (0.5, 1.0), (0.25, 0.75), (0.0, 0.75), (0.25, 1.0))
GOAL = 0.95

Answer = tuple[tuple[str, ...], ...]


def contradict(one: Answer, other: Answer) -> bool:
    """Whether each of two answers names a cause that the other one lacks."""
    return bool(_lacking(one, other)) and bool(_lacking(other, one))


def _lacking(answer: Answer, other: Answer) -> Answer:
    """The sets of ``answer`` that share no name with a set of ``other``."""
    return tuple(group for group in answer if all(set(group).isdisjoint(there) for there in other))


@dataclass(frozen=True)
class CropsOutcome:
    """The answers on the crops of one record."""

    kind: str
    seed: int
    base: str
    hidden: tuple[str, ...]
    answers: tuple[Answer, ...]
    seconds: float

    @property
    def contradictions(self) -> int:
        """Number of pairs of answers that contradict each other."""
        return sum(contradict(one, other) for one, other in combinations(self.answers, 2))

    def told(self) -> str:
        """The record and its answers in one line."""
        words = "; ".join(
            f"{low:g}-{high:g}: " + (", ".join(" or ".join(group) for group in answer) or "nothing")
            for (low, high), answer in zip(CROPS, self.answers, strict=True)
        )
        word = f"CONTRADICTS {self.contradictions} x" if self.contradictions else "agrees"
        hidden = ", ".join(self.hidden) or "nothing"
        return f"{self.kind}/{self.seed} on {self.base}, hidden {hidden}: {word} ({self.seconds:.0f} s): {words}"


def run_crops(kind: str, seed: int) -> CropsOutcome:
    """Diagnose every crop of the case ``kind``/``seed``. A crop that is refused names nothing."""
    case = KINDS[kind](seed)
    whole = recording_of(case)
    answers: list[Answer] = []
    begin = time.perf_counter()
    for low, high in CROPS:
        part = whole.part(int(low * len(whole)), int(high * len(whole)))
        try:
            said = diagnose_prepared(prepare(part, nominal=nominal_of(case)))
        except InputError:
            answers.append(())
            continue
        answers.append(named_in(case, said))
    return CropsOutcome(kind, seed, case.rig.base, case.hidden, tuple(answers), time.perf_counter() - begin)


def outcomes_of(cases: Sequence[tuple[str, int]], jobs: int) -> Iterator[CropsOutcome]:
    """Outcomes as they come. Raises what a record raised."""
    with ProcessPoolExecutor(jobs) as pool:
        for future in as_completed([pool.submit(run_crops, kind, seed) for kind, seed in cases]):
            yield future.result()


def main(argv: list[str] | None = None) -> int:
    """Run the records and print the share without a contradiction."""
    parser = argparse.ArgumentParser(prog="python -m tests.hidden.foreign.crops", description=__doc__)
    parser.add_argument("--records", type=int, default=20, help="records, one and two causes in turn (20)")
    parser.add_argument("--first", type=int, default=0, help="first seed (0)")
    parser.add_argument("--jobs", type=int, default=2, help="processes (2)")
    parser.add_argument("--json", metavar="FILE", help="write every outcome there, after each record")
    args = parser.parse_args(argv)
    cases = [(("single", "pair")[i % 2], args.first + i // 2) for i in range(args.records)]
    done: list[CropsOutcome] = []
    for outcome in outcomes_of(cases, args.jobs):
        done.append(outcome)
        print(f"[{len(done)}/{len(cases)}] {outcome.told()}", file=sys.stderr, flush=True)
        if args.json:
            with open(args.json, "w", encoding="utf-8") as file:
                json.dump([asdict(o) for o in done], file, indent=1)
    whole, pairs = sum(not o.contradictions for o in done), len(done) * len(CROPS) * (len(CROPS) - 1) // 2
    share = f"{100 * whole / len(done):.0f} %; goal {100 * GOAL:.0f} %"
    print(f"records without a contradiction: {whole} of {len(done)} ({share})")
    print(f"pairs of crops that contradict each other: {sum(o.contradictions for o in done)} of {pairs}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
