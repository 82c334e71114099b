"""The benchmark of ablations: what it finds in a source, what it shifts, and what it calls worse."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Collection
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import ablation
from benchmarks.ablation import (
    ORDER,
    RULES,
    Constant,
    Numbers,
    Settings,
    ablate,
    all_constants,
    constants_of,
    field_variants,
    readers_of,
    rule_variants,
    shift,
    table,
    variants_of,
    worse_rows,
)
from dehyst.adaptive.online.glitch_or_jump import level_of
from dehyst.adaptive.online.learner import Judgement

TEXT = '''
"""A module."""
from x import OTHER
LIMIT: Final = 0.5
COUNT, SHARE = 3, (0.6, 1.7)
SLOPES = (0.0, 25.0)
TURNS = (0.0, 0.1, 0.4)
NAME, NONE, FLAG, ZERO, NOWHERE, BELOW = "name", None, True, 0, -1, -2.5
TWICE = 2 * OTHER
def f():
    LOCAL = 3
class C:
    FIELD = 4
'''


def test_the_constants_of_a_module_are_its_numbers_and_tuples_of_numbers() -> None:
    found = {constant.label: constant for constant in constants_of(TEXT, "a.m")}
    assert list(found) == ["m.LIMIT", "m.COUNT", "m.SHARE[0]", "m.SHARE[1]", "m.SLOPES[1]", "m.TURNS", "m.BELOW"]
    assert found["m.SHARE[1]"].shifted(2.0) == (0.6, 3.4)
    assert found["m.TURNS"].shifted(2.0) == (0.0, 0.2, 0.8)
    assert (found["m.COUNT"].shifted(0.5), found["m.BELOW"].shifted(2.0)) == (2, -5.0)


def test_every_module_of_the_learner_is_looked_through_and_every_rule_replaces_what_is_there() -> None:
    modules = {constant.module.rpartition(".")[2] for constant in all_constants()}
    assert modules == {*ORDER, "kernel_window"}
    assert [rule.name for rule in RULES if not rule.places] == [
        "roll back to a mark", "a sudden change is detected",
    ]  # these replace a number # fmt: skip
    assert len({variant.name for variant in (*rule_variants(), *field_variants())}) > 80


def text_of(places: Collection[tuple[str, int]]) -> set[str]:
    """The beginnings of lines."""
    found = (Path(file).read_text().splitlines()[line - 1].split() for file, line in places)
    return {" ".join(words[:6]).partition("r, d")[0] for words in found}


def constant(label: str) -> Constant:
    return next(constant for constant in all_constants() if constant.label == label)


def in_a_process(call: Callable[[], Any]) -> Any:
    """The result of a call in a forked process: a shift is for ever."""

    def work(towards: Connection) -> None:
        towards.send(call())

    context = multiprocessing.get_context("fork")
    source, towards = context.Pipe(duplex=False)
    process = context.Process(target=work, args=(towards,))
    process.start()
    towards.close()
    try:
        return source.recv()
    finally:
        process.join()


def test_a_shift_reaches_compiled_code_and_what_calls_it() -> None:
    swing = np.arange(12.0) % 3.0
    readers = readers_of("dehyst.adaptive.online.glitch_or_jump", "NO_LEVEL")
    assert readers.compiled == (("dehyst.adaptive.online.glitch_or_jump", "_fit"),)
    # Tests that were imported before read it too.
    product = [place for place in readers.places if "tests" not in Path(place[0]).parts]
    assert text_of(product) == {"_fit(np.ascontiguousarray(", "if remainder < NO_LEVEL:"}
    assert np.isfinite(level_of(swing, 1e-3).std)

    def shifted() -> float:
        shift(constant("glitch_or_jump.NO_LEVEL"), 100.0)
        return level_of(swing, 1e-3).std

    assert in_a_process(shifted) == np.inf
    assert np.isfinite(level_of(swing, 1e-3).std)


def test_a_shift_reaches_importers() -> None:
    def shifted() -> tuple[int, int]:
        shift(constant("sensor_trust.STILL_STEPS"), 40)
        return ablation.intake.STILL_STEPS, ablation.sensor_trust.STILL_STEPS

    assert in_a_process(shifted) == (40, 40)


# ---- comparison


def case(value: float, **given: Any) -> Numbers:
    return {"median": value, "worst": value, "refused": 0.1, "large_s": 0.0, "unnamed": False} | given


NAMES = [f"c{i}" for i in range(8)]
BASE = {name: case(1.0) for name in NAMES}
#: What other noise does: a tenth, up and down.
REPEATED = [{name: case(1.1 if (i + k) % 2 else 1 / 1.1) for i, name in enumerate(NAMES)} for k in range(2)]


def rows(variant: dict[str, Numbers], comparisons: int = 1000, sign: int = 1) -> list[str]:
    return [str(row) for row in worse_rows(variant, BASE, REPEATED, {"sensor": NAMES}, comparisons, sign)]


def test_a_row_is_worse_where_its_cases_grow_by_more_than_other_noise_does() -> None:
    grown = {name: case(1.0, worst=1.5) for name in NAMES}
    assert rows(grown) == ["sensor worst × 1.48"]
    assert rows(grown, sign=-1) == []
    # As much in one case only, or as other noise does, or equal.
    assert rows(BASE | {"c0": case(1.0, worst=100.0)}) == []
    assert rows(REPEATED[0]) == []
    assert rows(BASE) == []


# ---- the whole way, over made-up cases


@dataclass(frozen=True)
class FallbackCase:
    """How long an identified model that is better by a third is not served; and steps that are counted meanwhile."""

    name: str
    seed: int
    group: str = "intact"

    def run(self, noise: int, settings: Settings) -> Numbers:
        rng = np.random.default_rng([self.seed, noise])
        judgement, waited = Judgement(0.01, 0.01, 0.01, 0.01), 0
        for _ in range(400):
            judgement.take(1.5 * rng.normal(), rng.normal(), 1e-3)
            waited += not judgement.choose(0.0, 1e-3)
        return {"median": 1.0 + waited, "worst": 1.0, "refused": 0.0, "large_s": 0.0, "accused": False}


@pytest.fixture
def cases() -> list[ablation.Case]:
    return [FallbackCase(f"stage {seed}", seed) for seed in range(8)]


def test_a_constant_that_matters_is_told_from_one_that_does_not(
    cases: list[ablation.Case], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    planned = [
        v
        for label in ("learner.FALLBACK_RATIO", "learner.NEWEST", "learner.LONG_S")
        for v in variants_of(constant(label))
    ]
    path, to = tmp_path / "a.jsonl", tmp_path / "table.md"
    results = ablate(cases, planned, jobs=2, path=path, to=to)
    assert [row.measure for row in results.worse("learner.FALLBACK_RATIO twice")] == ["median"]
    assert not results.worse("learner.FALLBACK_RATIO half")
    # Gone through and the same, and not gone through: nothing was tried then.
    assert "learner.LONG_S half (8 cases run): the same" in capsys.readouterr().err
    _, nothing, worth, untested = to.read_text().split("###")
    assert nothing.startswith(" changes nothing, to the last bit (1)")
    assert "learner.LONG_S | 2.0 | the same | the same" in nothing
    assert worth.startswith(" worth its place (1)")
    assert "learner.FALLBACK_RATIO | 1.3" in worth
    assert untested.startswith(" not tested by these cases (1)")
    assert "learner.NEWEST | 100 | no case goes there" in untested
    assert table(results) + "\n" == to.read_text()

    again = ablate(cases, [*planned, *variants_of(constant("learner.SHORT_S"))], path=path)
    said = capsys.readouterr().err
    assert "FALLBACK_RATIO" not in said
    assert "learner.SHORT_S twice (8 cases run)" in said
    assert again.untested == results.untested
    assert again.worse("learner.FALLBACK_RATIO twice") == results.worse("learner.FALLBACK_RATIO twice")
