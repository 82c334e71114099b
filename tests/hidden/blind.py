"""Score the diagnosis on recordings whose truth it cannot see: ``python -m tests.hidden.blind`` (or ``make blind``).

Prints, for each kind of case, how many named everything that was hidden (*contained*) and how many named that and
nothing else (*exact*, which alone counts as right), what was named for what, and the rate of false alarms.
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

from tests.hidden.cases import healthy, other_class, pair, same, single, small
from tests.hidden.excitation import FS_HZ, excitation
from tests.hidden.stage import Truth, record

KINDS = {"single": single, "pair": pair, "healthy": healthy, "other_class": other_class, "small": small}
#: What has to be right in each kind, as shares of its cases.
REQUIRED = {"single": 0.95, "pair": 0.85, "healthy": 0.98, "other_class": 0.85, "small": 1.0}

Named = tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Judgement:
    """``contained``: everything hidden is named. ``right``: that and nothing else; for what is smaller than the noise
    also nothing at all."""

    contained: bool
    right: bool
    #: First names of what was named beside the truth.
    extra: tuple[str, ...] = ()


@dataclass(frozen=True)
class Outcome:
    """What was hidden, what was said, and whether that is right."""

    kind: str
    seed: int
    hidden: tuple[str, ...]
    verdict: str
    named: Named
    contained: bool
    right: bool
    extra: tuple[str, ...]
    over_floor: float
    seconds: float
    cpu_s: float


def wanted(kind: str, truth: Truth) -> set[str]:
    """The names that must be given."""
    return set(truth.effects) | ({"hysteresis_shape"} if kind == "other_class" else set())


def _matched(groups: list[frozenset[str]], names: list[str]) -> int:
    """How many groups can each be given a name of its own that they hold (the largest matching)."""
    if not groups:
        return 0
    first, rest = groups[0], groups[1:]
    own = (1 + _matched(rest, [n for n in names if n != name]) for name in names if same(name, set(first)))
    return max((_matched(rest, names), *own))


def judge(kind: str, truth: Truth, verdict: str, named: Named) -> Judgement:
    """What of the truth was named, and what beside it. A cause and its alternatives are one group, worth one name."""
    groups = [frozenset(group) for group in named]
    names = sorted(wanted(kind, truth))
    extra: list[str] = []
    kept: list[frozenset[str]] = []
    for group in named:
        more = [*kept, frozenset(group)]
        if _matched(more, names) == len(more):
            kept = more
        else:
            extra.append(group[0])
    if kind == "healthy":
        return Judgement(verdict == "adequate", verdict == "adequate", tuple(extra))
    if kind == "small":
        fine = verdict == "adequate" or (verdict in ("effects", "partly") and not extra)
        return Judgement(fine, fine, tuple(extra))
    found = {name for group in groups for name in group}
    contained = verdict in ("effects", "partly") and all(same(name, found) for name in names)
    return Judgement(contained, contained and not extra, tuple(extra))


def run_case(kind: str, seed: int) -> Outcome:
    """Make the recording, diagnose it as `dehyst diagnose` does, and judge the answer."""
    from dehyst.sim.diagnosis import diagnose_prepared, prepare
    from dehyst.sim.recordings import Recording

    truth = KINDS[kind](seed)
    columns = record(truth, *excitation(np.random.default_rng(seed)))
    start, cpu = time.perf_counter(), time.process_time()
    prepared = prepare(Recording(**columns, dt_s=1.0 / FS_HZ, source=f"{kind}/{seed}"))
    said = diagnose_prepared(prepared)
    seconds, cpu = time.perf_counter() - start, time.process_time() - cpu
    named = tuple((cause.name, *cause.alternatives) for cause in said.causes)
    judgement = judge(kind, truth, said.verdict, named)
    return Outcome(
        kind,
        seed,
        tuple(truth.effects),
        said.verdict,
        named,
        judgement.contained,
        judgement.right,
        judgement.extra,
        said.extended_heldout_um / said.noise_floor_um,
        seconds,
        cpu,
    )


def table(outcomes: list[Outcome]) -> str:
    """Rates by kind with what they must be, the confusion matrix, the false alarms, the error left, the time."""
    lines = [
        "kind          cases  contained  exact  share (needed)  error < 1.5 floor  median s   max s  cpu max s",
    ]
    for kind in KINDS:
        own = [o for o in outcomes if o.kind == kind]
        if own:
            exact, contained = sum(o.right for o in own), sum(o.contained for o in own)
            low = sum(o.over_floor < 1.5 for o in own)
            wall = [o.seconds for o in own]
            lines.append(
                f"{kind:<13} {len(own):5d} {contained:10d} {exact:6d}  {100 * exact / len(own):4.0f} % "
                f"({100 * REQUIRED[kind]:3.0f} %) {100 * low / len(own):16.0f} % {float(np.median(wall)):9.1f} "
                f"{max(wall):7.1f} {max(o.cpu_s for o in own):10.1f}"
            )
    quiet = [o for o in outcomes if o.kind == "healthy"]
    if quiet:
        alarms = sum(not o.right for o in quiet)
        lines.append(
            f"false alarms on healthy recordings: {alarms} of {len(quiet)} ({100 * alarms / len(quiet):.1f} %)"
        )
    lines += ["", *confusion(outcomes)]
    wrong = Counter(
        (o.kind, " + ".join(o.hidden) or "nothing", o.verdict, " + ".join(g[0] for g in o.named) or "nothing")
        for o in outcomes
        if not o.right
    )
    lines += [
        f"not exact: {kind}: hidden {hid}, said {ver}: {named} ({n} x)" for (kind, hid, ver, named), n in wrong.items()
    ]
    return "\n".join(lines)


def confusion(outcomes: list[Outcome]) -> list[str]:
    """Rows: what was hidden (in singles, pairs and on the other class). Columns: how often it was named first of its
    group, named as an alternative, missed, and what stood beside it that was not there."""
    lines = ["hidden                 cases  first  other  missed  named beside it"]
    told = [o for o in outcomes if o.kind in ("single", "pair", "other_class")]
    names = sorted({name for o in told for name in o.hidden})
    for name in names:
        own = [o for o in told if name in o.hidden]
        first = sum(name in {group[0] for group in o.named} for o in own)
        some = sum(same(name, {n for group in o.named for n in group}) for o in own)
        beside = Counter(extra for o in own for extra in o.extra)
        words = ", ".join(f"{extra} {n}" for extra, n in beside.most_common()) or "-"
        lines.append(f"{name:<22} {len(own):5d} {first:6d} {some - first:6d} {len(own) - some:7d}  {words}")
    return lines


def main(argv: list[str] | None = None) -> int:
    """Run all cases. Returns 0; the numbers say how good it is."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--single", type=int, default=102, help="cases with one hidden effect (102)")
    parser.add_argument("--pair", type=int, default=40, help="cases with two (40)")
    parser.add_argument("--healthy", type=int, default=50, help="cases with none (50)")
    parser.add_argument("--other-class", type=int, default=17, help="one effect on a many-play hysteresis (17)")
    parser.add_argument("--small", type=int, default=9, help="one effect of half the noise (9)")
    parser.add_argument("--first", type=int, default=0, help="first seed (0)")
    parser.add_argument("--jobs", type=int, default=2, help="processes (2)")
    parser.add_argument("--json", metavar="FILE", help="write every outcome there")
    args = parser.parse_args(argv)
    counts = {
        "single": args.single,
        "pair": args.pair,
        "healthy": args.healthy,
        "other_class": args.other_class,
        "small": args.small,
    }
    jobs = [(kind, args.first + i) for kind, count in counts.items() for i in range(count)]
    outcomes: list[Outcome] = []
    with ProcessPoolExecutor(args.jobs) as pool:
        waiting = {pool.submit(run_case, kind, seed): (kind, seed) for kind, seed in jobs}
        for future in as_completed(waiting):
            outcome = future.result()
            outcomes.append(outcome)
            word = "exact" if outcome.right else "extra" if outcome.contained else "WRONG"
            named = ", ".join(" or ".join(group) for group in outcome.named) or "nothing"
            print(
                f"[{len(outcomes)}/{len(jobs)}] {outcome.kind}/{outcome.seed} {word}: hidden "
                f"{', '.join(outcome.hidden) or 'nothing'}; {outcome.verdict}: {named} ({outcome.seconds:.0f} s, "
                f"{outcome.over_floor:.2f} floors)",
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
