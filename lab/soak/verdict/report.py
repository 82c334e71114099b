"""``report.md`` of a soak: the verdict, the invariants, every kind of fault, the pictures."""

from __future__ import annotations

from typing import Any

from lab.soak.faults.catalogue import KINDS
from lab.soak.faults.plan import SoakPlan
from lab.soak.verdict.ledger import REAL_TIME, Ledger
from lab.soak.verdict.outcome import SECONDS, verdict_line


def report(found: dict[str, Any], ledger: Ledger, plan: SoakPlan, pictures: list[str], interrupted: bool) -> str:
    """The page, from what is in ``soak.json`` and what it leaves out."""
    lines = [f"# Soak: {verdict_line(found)}", ""]
    how = "in real time, in processes" if ledger.mode == REAL_TIME else "in one process, as fast as it goes"
    lines.append(
        f"{found['duration_s']:g} s of {plan.duration_s:g} s {how}; seed {plan.seed}; {len(ledger.faults)} of "
        f"{len(plan.faults)} planned faults." + (" Interrupted: this is what ran." if interrupted else "")
    )
    if plan.left_out:
        lines += ["", f"No time was left for: {', '.join(plan.left_out)}."]
    lines += ["", *(f"- {note}" for note in dict.fromkeys(ledger.notes))]
    lines += ["", "## What must hold", "", "| invariant | held | worst | limit | |", "|---|---|---|---|---|"]
    for name, row in found["invariants"].items():
        worst = "-" if row["worst"] is None else f"{row['worst']:.4g}"
        held = {True: "yes", False: "**no**", None: "not judged"}[row["held"]]
        lines.append(f"| {name} | {held} | {worst} | {row['limit']:.4g} {row['unit']} | {row['text']} |")
    lines += ["", "## Faults", ""]
    lines += [
        "| fault | | how often | well again after, s | allowed | silence, s | told by |",
        "|---|---|---|---|---|---|---|",
    ]
    for kind, row in found["faults"].items():
        recovery = "never" if row["recovered"] < row["count"] else _number(row["worst_recovery_s"])
        told = (
            ", ".join(row["told_by"]).replace("-", "nobody is to", 1)
            if row["told_by"] == ["-"]
            else ", ".join(row["told_by"])
        )
        lines.append(
            f"| {kind} | {KINDS[kind].what} | {row['count']} | {recovery} | {KINDS[kind].recover_s:g} | "
            f"{_number(row['worst_silence_s'])} | {told or '**nobody**'} |"
        )
    for end_s, name in ledger.ended:
        lines += ["", f"**{name} ended by itself at {end_s:.1f} s**; see `logs/`."]
    latency = found["latency"]
    if latency["p50_us"] is not None and latency["echo_p50_us"]:
        ratios = [latency[q] / latency[f"echo_{q}"] for q in ("p50_us", "p99_us")]
        lines += [
            "", "## Latency outside fault windows", "",
            f"A point: median {latency['p50_us']:.0f} µs, 99 % within {latency['p99_us']:.0f} µs, 99.9 % within "
            f"{latency['p999_us']:.0f} µs. A bare echo of as many bytes through the same router, in turns with it: "
            f"median {latency['echo_p50_us']:.0f} µs, 99 % within {latency['echo_p99_us']:.0f} µs. That is "
            f"{ratios[0]:.2f} and {ratios[1]:.2f} times.",
        ]  # fmt: skip
    slope = found["memory_slope_kb_per_hour"]
    lines += ["", "## Memory", "", "Not judged." if slope is None else f"{slope:.0f} kB an hour."]
    samples = ", ".join(f"{name} {value}" for name, value in found["samples"].items())
    lines += ["", "## Samples", "", f"{samples}.", ""]
    lines += [f"Second by second in `{SECONDS}`.", ""]
    lines += [f"![{name}]({name})" for name in pictures]
    return "\n".join(lines) + "\n"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"
