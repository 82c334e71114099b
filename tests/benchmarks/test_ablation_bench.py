"""The benchmark of ablations: what its rules replace, and what it calls worse."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import ablation
from benchmarks.ablation import RULES, Numbers, Settings, Variant, ablate, field_variants, table, worse_rows
from dehyst.adaptive.online import learner
from dehyst.adaptive.online.learner import Judgement


def test_every_rule_replaces_what_is_there() -> None:
    assert all(name in vars(owner) for rule in RULES for owner, name, _ in rule.replaces)
    assert len({variant.name for variant in field_variants()}) > 50


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


def begins(name: str, value: float) -> Variant:
    rule = ablation.Rule(name, ((learner, name, value),))
    return Variant(name, name, {}, rule.switch_off, "as it is")


def test_a_variant_that_matters_is_told_from_one_that_does_not(
    cases: list[ablation.Case], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    planned = [begins("FALLBACK_RATIO", 2.0 * learner.FALLBACK_RATIO), begins("LONG_S", 2.0 * learner.LONG_S)]
    path, to = tmp_path / "a.jsonl", tmp_path / "table.md"
    before = learner.FALLBACK_RATIO
    results = ablate(cases, planned, jobs=2, path=path, to=to)
    assert before == learner.FALLBACK_RATIO
    assert [row.measure for row in results.worse("FALLBACK_RATIO")] == ["median"]
    assert "LONG_S: the same" in capsys.readouterr().err
    _, nothing, worth = to.read_text().split("###")
    assert nothing.startswith(" changes nothing, to the last bit (1)")
    assert "LONG_S | as it is | the same | -" in nothing
    assert worth.startswith(" worth its place (1)")
    assert "FALLBACK_RATIO" in worth
    assert table(results) + "\n" == to.read_text()

    again = ablate(cases, [*planned, begins("SHORT_S", 2.0 * learner.SHORT_S)], path=path)
    said = capsys.readouterr().err
    assert "FALLBACK_RATIO:" not in said
    assert "SHORT_S: " in said
    assert again.worse("FALLBACK_RATIO") == results.worse("FALLBACK_RATIO")
