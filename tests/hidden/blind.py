"""Score the diagnosis on recordings whose truth it cannot see: ``python -m tests.hidden.blind`` (or ``make blind``).

Prints, for each kind of case, how many were named right, what was named instead, and the rate of false alarms.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from tests.hidden.cases import healthy, other_class, pair, same, single
from tests.hidden.excitation import FS_HZ, excitation
from tests.hidden.stage import Truth, record

KINDS = {"single": single, "pair": pair, "healthy": healthy, "other_class": other_class}


@dataclass(frozen=True)
class Outcome:
    """What was hidden, what was said, and whether that is right."""

    kind: str
    seed: int
    hidden: tuple[str, ...]
    verdict: str
    named: tuple[tuple[str, ...], ...]
    right: bool
    over_floor: float
    seconds: float


def judge(kind: str, truth: Truth, verdict: str, named: tuple[tuple[str, ...], ...]) -> bool:
    """Whether every hidden cause was named, or nothing was hidden and nothing named."""
    found = {name for group in named for name in group}
    if kind == "healthy":
        return verdict == "adequate"
    wanted = set(truth.effects) | ({"hysteresis_shape"} if kind == "other_class" else set())
    return all(same(name, found) for name in wanted)


def run_case(kind: str, seed: int) -> Outcome:
    """Make the recording, diagnose it as `dehyst diagnose` does, and judge the answer."""
    from sim.diagnosis.diagnose import diagnose
    from sim.diagnosis.prepare import prepare
    from sim.recordings import Recording

    truth = KINDS[kind](seed)
    columns = record(truth, *excitation(np.random.default_rng(seed)))
    start = time.perf_counter()
    prepared = prepare(Recording(**columns, dt_s=1.0 / FS_HZ, source=f"{kind}/{seed}"))
    said = diagnose(prepared.setting, prepared.mask, notes=prepared.notes, dropped=prepared.dropped)
    seconds = time.perf_counter() - start
    named = tuple((cause.name, *cause.alternatives) for cause in said.causes)
    return Outcome(
        kind,
        seed,
        tuple(truth.effects),
        said.verdict,
        named,
        judge(kind, truth, said.verdict, named),
        said.extended_heldout_um / said.noise_floor_um,
        seconds,
    )


def table(outcomes: list[Outcome]) -> str:
    """Rates by kind, and what was said where it was wrong."""
    lines = ["kind          cases  right  share  median s"]
    for kind in KINDS:
        own = [o for o in outcomes if o.kind == kind]
        if own:
            right = sum(o.right for o in own)
            seconds = float(np.median([o.seconds for o in own]))
            lines.append(f"{kind:<13} {len(own):5d} {right:6d} {100 * right / len(own):5.0f} % {seconds:8.1f}")
    wrong = Counter(
        (o.kind, " + ".join(o.hidden) or "nothing", o.verdict, " + ".join(g[0] for g in o.named) or "nothing")
        for o in outcomes
        if not o.right
    )
    lines += [
        f"wrong: {kind}: hidden {hid}, said {ver}: {named} ({n} x)" for (kind, hid, ver, named), n in wrong.items()
    ]
    return "\n".join(lines)


def main(argv: list[str] | None = None) -> int:
    """Run all cases. Returns 0; the numbers say how good it is."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--single", type=int, default=102, help="cases with one hidden effect (102)")
    parser.add_argument("--pair", type=int, default=40, help="cases with two (40)")
    parser.add_argument("--healthy", type=int, default=50, help="cases with none (50)")
    parser.add_argument("--other-class", type=int, default=17, help="one effect on a many-play hysteresis (17)")
    parser.add_argument("--first", type=int, default=0, help="first seed (0)")
    parser.add_argument("--jobs", type=int, default=2, help="processes (2)")
    parser.add_argument("--json", metavar="FILE", help="write every outcome there")
    args = parser.parse_args(argv)
    counts = {
        "single": args.single,
        "pair": args.pair,
        "healthy": args.healthy,
        "other_class": args.other_class,
    }
    jobs = [(kind, args.first + i) for kind, count in counts.items() for i in range(count)]
    outcomes: list[Outcome] = []
    with ProcessPoolExecutor(args.jobs) as pool:
        waiting = {pool.submit(run_case, kind, seed): (kind, seed) for kind, seed in jobs}
        for future in as_completed(waiting):
            outcome = future.result()
            outcomes.append(outcome)
            word = "right" if outcome.right else "WRONG"
            named = ", ".join(" or ".join(group) for group in outcome.named) or "nothing"
            print(
                f"[{len(outcomes)}/{len(jobs)}] {outcome.kind}/{outcome.seed} {word}: hidden "
                f"{', '.join(outcome.hidden) or 'nothing'}; {outcome.verdict}: {named} ({outcome.seconds:.0f} s)",
                file=sys.stderr,
                flush=True,
            )
    print(table(outcomes))
    if args.json:
        found: list[dict[str, Any]] = [asdict(o) for o in outcomes]
        with open(args.json, "w", encoding="utf-8") as file:
            json.dump(found, file, indent=1)
    return 0


if __name__ == "__main__":
    sys.exit(main())
