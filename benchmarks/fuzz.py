"""Coverage-guided fuzzing of everything that decodes bytes of others, and of a live service.

::

    python -m benchmarks.fuzz --out out/fuzz                        # a million payloads, then 30 s against a service
    python -m benchmarks.fuzz --out out/fuzz --payloads 50000 --live 0
    python -m benchmarks.fuzz --repeat out/fuzz/model-crash-1a2b    # run one payload again

The engine is libFuzzer through atheris: it keeps each payload that reaches new code, and mutates those. A payload
crashes the run if its target raises an undocumented exception, takes seconds, or allocates gigabytes; it is then kept
as a file. Each target runs in a process of its own. New payloads stay in DIR/corpus for the next run. Exit status 1 if
anything crashed, memory grew, or honest clients were slowed down.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, Final

#: The package whose branches guide the mutations (atheris takes whole ones), and its folders that run at full speed.
PACKAGE, OTHERS = "dehyst", ("adaptive", "baselines", "sim", "lab")
#: Modules with compiled functions: numba cannot compile what the fuzzer inserts.
COMPILED: Final = ("dehyst.service.answers.guard",)
_MAX_BYTES = 4096
_SLOW_S = 5
_RSS_LIMIT_MB = 2048
#: A target whose process ends with so much more memory than after its first tenth has leaked, MB.
_GROWTH_MB = 64.0


def main() -> int:
    """Run the fuzzer; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.fuzz", description=__doc__.split("\n", 1)[0])
    add = parser.add_argument
    add("--out", type=Path, default=Path("out/fuzz"), metavar="DIR", help="corpus, crashes and fuzz.json (%(default)s)")
    add("--payloads", type=int, default=1_000_000, metavar="N", help="in all, over the targets (%(default)s)")
    add("--target", action="append", metavar="NAME", help="only this one; repeatable")
    add("--live", type=float, default=30.0, metavar="S", help="fire at a live service for so long, s; 0: not (30)")
    add("--rate", type=float, default=1000.0, metavar="HZ", help="payloads a second at the live service (%(default)s)")
    add("--seed", type=int, default=1, help="of the mutations (%(default)s)")
    add("--repeat", type=Path, metavar="FILE", help="only run the target of this crash file on it")
    add("--child", help=argparse.SUPPRESS)
    args = parser.parse_args()
    from benchmarks.fuzz_targets import EXPECTED, TARGETS

    if args.child:
        return _child(args.child, args)
    if args.repeat:
        TARGETS[args.repeat.name.split("-", 1)[0]]()(args.repeat.read_bytes())
        print(f"{args.repeat}: nothing raised beyond {', '.join(kind.__name__ for kind in EXPECTED)}")
        return 0
    names = args.target or list(TARGETS)
    for name in names:
        if name not in TARGETS:
            parser.error(f"--target {name}: one of {', '.join(TARGETS)}")
    args.out.mkdir(parents=True, exist_ok=True)
    targets = [_fuzz(name, -(-args.payloads // len(names)), args) for name in names]
    report: dict[str, Any] = {
        "schema": 1,
        "payloads": sum(target["payloads"] for target in targets),
        "crashes": sum(len(target["crashes"]) for target in targets),
        "targets": targets,
    }
    held = all(target["held"] for target in targets)
    if args.live > 0.0:
        from benchmarks.fuzz_live import bombard

        report["live"] = bombard(args.out / "live", args.live, args.rate, args.seed)
        held = held and report["live"]["held"]
    report["held"] = held
    (args.out / "fuzz.json").write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    print(f"{report['payloads']} payloads, {report['crashes']} crashes; {'held' if held else 'NOT held'}: "
          f"{args.out / 'fuzz.json'}")  # fmt: skip
    return 0 if held else 1


def _fuzz(name: str, payloads: int, args: argparse.Namespace) -> dict[str, Any]:
    """One target in a process of its own."""
    from benchmarks.fuzz_targets import seeds

    corpus = args.out / "corpus" / name
    corpus.mkdir(parents=True, exist_ok=True)
    for i, payload in enumerate(seeds(name)):
        (corpus / f"honest-{i}").write_bytes(payload)
    start = time.monotonic()
    before = set(args.out.glob(f"{name}-*"))
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.fuzz", "--child", name, "--payloads", str(payloads), "--seed",
         str(args.seed), "--out", str(args.out)],
        capture_output=True, text=True, errors="replace", check=False,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    text = done.stdout + done.stderr
    if "No module named 'atheris'" in text:
        sys.exit("the fuzzer is not installed: pip install 'dehyst[fuzz]' (Linux on x86-64)")
    run = _read_log(text)
    crashes = sorted(str(path.name) for path in set(args.out.glob(f"{name}-*")) - before)
    held = done.returncode == 0 and not crashes and run["payloads"] >= payloads and run["grown_MB"] <= _GROWTH_MB
    told = {"target": name, **run, "wall_s": time.monotonic() - start, "crashes": crashes, "held": held}
    print(f"{name:<10} {run['payloads']:>8} payloads, {run['edges']} edges, {run['corpus']} kept, "
          f"{run['grown_MB']:+.0f} MB, {told['wall_s']:.0f} s{'' if held else '  NOT held'}", flush=True)  # fmt: skip
    if not held:
        (args.out / f"{name}.log").write_text(text, encoding="utf-8")
        print(text[-1500:], file=sys.stderr)
    return told


def _read_log(text: str) -> dict[str, Any]:
    """What libFuzzer reports of a run: payloads, edges covered, payloads kept, and growth of memory."""
    lines = re.findall(r"#(\d+)\s+\w+\s+cov: (\d+) .*?corp: (\d+)/.*?rss: (\d+)Mb", text)
    done = re.search(r"stat::number_of_executed_units: (\d+)", text)
    rows = [tuple(map(int, line)) for line in lines]
    settled = next((rss for n, _, _, rss in rows if rows and n >= rows[-1][0] / 10), 0)
    _, edges, kept, rss = rows[-1] if rows else (0, 0, 0, 0)
    return {
        "payloads": int(done[1]) if done else 0,
        "edges": edges,
        "corpus": kept,
        "rss_MB": rss,
        "grown_MB": float(rss - settled),
    }


def _child(name: str, args: argparse.Namespace) -> int:
    """The process that fuzzes one target; libFuzzer ends it."""
    import atheris

    # Modules that are imported here are instrumented, so they must not be imported yet.
    for module in [m for m in sys.modules if m.split(".")[0] in ("dehyst", "benchmarks", "tests")]:
        if module != "benchmarks.fuzz":
            del sys.modules[module]
    root = Path(__file__).resolve().parents[1]
    paths = (path.relative_to(root).with_suffix("") for part in OTHERS for path in (root / part).rglob("*.py"))
    others = (".".join((PACKAGE, *path.parts)).removesuffix(".__init__") for path in paths)
    left_out = [PACKAGE, *COMPILED, *others]
    with atheris.instrument_imports([PACKAGE], left_out, enable_loader_override=False):
        from benchmarks.fuzz_targets import TARGETS, WORDS, seeds
    words = args.out / f"words-{name}.txt"
    quoted = (word.replace("\\", "\\\\").replace('"', '\\"') for word in WORDS)
    words.write_text("".join(f'"{word}"\n' for word in quoted), encoding="utf-8")
    target = TARGETS[name]()
    for payload in seeds(name):
        target(payload)  # compile before the run
    atheris.Setup(
        [
            sys.argv[0], f"-runs={args.payloads}", f"-seed={args.seed}", f"-max_len={_MAX_BYTES}",
            f"-timeout={_SLOW_S}", f"-rss_limit_mb={_RSS_LIMIT_MB}", f"-artifact_prefix={args.out}/{name}-",
            f"-dict={words}", "-print_final_stats=1", str(args.out / "corpus" / name),
        ],
        target,
    )  # fmt: skip
    atheris.Fuzz()
    return 0


if __name__ == "__main__":
    sys.exit(main())
