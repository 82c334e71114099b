"""``python -m benchmarks.ablation_diagnosis``: which thresholds of the search decide anything.

Diagnoses injected records (`benchmarks.injections`) and foreign cases (`tests.hidden.foreign`). Every decision of the
search, whether a candidate is accepted, is asked again with each threshold off, doubled and halved. A row counts the
decisions that change, and names them. A threshold that changes none decides nothing.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields, replace
from typing import Any

from benchmarks.injections import RECORDS, run
from dehyst.sim.diagnosis import Thresholds
from dehyst.sim.diagnosis.search.search import CauseCandidate, Search
from tests.foreign.inject import ACCEPTED
from tests.hidden.foreign.score import KINDS, run_case

#: A threshold is off where its rule holds for all candidates.
_OFF = {"level": 1.0, "nearly_all": 2.0, "seen_eases": 1.0}
_ASKED = ("level", "least_of_floor", "least_share", "nearly_all", "seen_eases")


def variants() -> dict[str, Thresholds]:
    """The thresholds, each off, doubled and halved."""
    usual, out = Thresholds(), dict[str, Thresholds]()
    for field in fields(Thresholds):
        if field.name in _ASKED:
            value = getattr(usual, field.name)
            for word, other in (("off", _OFF.get(field.name, 0.0)), ("x 2", 2.0 * value), ("/ 2", 0.5 * value)):
                out[f"{field.name} {word}"] = replace(usual, **{field.name: other})
    return out


@contextmanager
def asked_again(changed: dict[str, list[str]], label: Callable[[], str]) -> Iterator[list[str]]:
    """Within it every decision is asked again; ``changed`` collects those that are different, the result all."""
    asked: list[str] = []
    acceptable = Search.acceptable

    def decide(self: Search, best: CauseCandidate, *known: Any) -> bool:
        decision, own = acceptable(self, best, *known), self.thresholds
        asked.append(best.cause.name)
        for name, other in variants().items():
            self.thresholds = other
            if acceptable(self, best, *known) != decision:
                changed.setdefault(name, []).append(f"{'-' if decision else '+'}{best.cause.name} [{label()}]")
        self.thresholds = own
        return decision

    Search.acceptable = decide  # type: ignore[method-assign]
    try:
        yield asked
    finally:
        Search.acceptable = acceptable  # type: ignore[method-assign]


def main() -> None:
    """Run the cases and print a row for each variant."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.ablation_diagnosis", description=__doc__.split("\n")[0])
    parser.add_argument("--injections", type=int, default=15)
    parser.add_argument("--foreign", type=int, default=4, help="cases of each kind")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    changed: dict[str, list[str]] = {}
    at = "injections"
    with asked_again(changed, lambda: at) as asked:
        run(list(RECORDS), list(ACCEPTED), given.seed, given.injections, None)
        for kind in KINDS:
            for seed in range(given.seed, given.seed + given.foreign):
                at = f"{kind}/{seed}"
                found = run_case(kind, seed)
                print(f"{at}: {found.judgement.right}, {found.hidden}: {found.named}", file=sys.stderr, flush=True)
    print(f"{len(asked)} decisions\n\n| changed | decisions |\n|---|---|")
    for name in variants():
        own = changed.get(name, [])
        print(f"| {name} | {len(own)}: {'; '.join(own[:8])} |")


if __name__ == "__main__":
    main()
