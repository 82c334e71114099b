"""Score the diagnosis on foreign cases: ``python -m tests.hidden.foreign --single 38 --pair 20 --healthy 24``."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict
from typing import Any

from tests.hidden.foreign.score import KINDS, Outcome, run_case, table


def outcomes_of(cases: list[tuple[str, int]], jobs: int) -> Iterator[tuple[str, int, Outcome | Exception]]:
    """Outcomes as they come. A case that raises is an outcome as well: the others go on."""
    with ProcessPoolExecutor(jobs) as pool:
        waiting = {pool.submit(run_case, kind, seed): (kind, seed) for kind, seed in cases}
        for future in as_completed(waiting):
            try:
                yield *waiting[future], future.result()
            except Exception as error:
                yield *waiting[future], error


def main(argv: list[str] | None = None) -> int:
    """Run the cases and print the table. Returns 1 if a case raised an error."""
    parser = argparse.ArgumentParser(prog="python -m tests.hidden.foreign", description=__doc__)
    parser.add_argument("--single", type=int, default=38, help="cases with one cause (38: each cause twice)")
    parser.add_argument("--pair", type=int, default=20, help="cases with two (20)")
    parser.add_argument("--triple", type=int, default=10, help="cases with three (10)")
    parser.add_argument("--healthy", type=int, default=24, help="cases with none (24)")
    parser.add_argument("--first", type=int, default=0, help="first seed (0)")
    parser.add_argument("--jobs", type=int, default=2, help="processes (2)")
    parser.add_argument("--json", metavar="FILE", help="write every outcome there, after each case")
    args = parser.parse_args(argv)
    counts: dict[str, int] = {kind: getattr(args, kind) for kind in KINDS}
    cases = [(kind, args.first + i) for kind, count in counts.items() for i in range(count)]
    done: list[Outcome] = []
    failed: list[str] = []
    for at, (kind, seed, outcome) in enumerate(outcomes_of(cases, args.jobs), 1):
        if isinstance(outcome, Exception):
            failed.append(f"{kind}/{seed}: {type(outcome).__name__}: {outcome}")
            print(f"[{at}/{len(cases)}] FAILED {failed[-1]}", file=sys.stderr, flush=True)
            continue
        done.append(outcome)
        word = "right" if outcome.judgement.right else "WRONG"
        named = ", ".join(" or ".join(group) for group in outcome.named) or "nothing"
        print(
            f"[{at}/{len(cases)}] {kind}/{seed} {word}: hidden {', '.join(outcome.hidden) or 'nothing'} on "
            f"{outcome.base}; {outcome.verdict}: {named} ({outcome.seconds:.0f} s, "
            f"error left {outcome.error_left:.2f} x)",
            file=sys.stderr,
            flush=True,
        )
        if args.json:
            rows: list[dict[str, Any]] = [asdict(o) for o in done]
            with open(args.json, "w", encoding="utf-8") as file:
                json.dump(rows, file, indent=1)
    if done:
        print(table(done))
    print(*(f"failed: {line}" for line in failed), sep="\n")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
