"""The benchmark of ablations: what it switches off, and what it calls worse."""

from __future__ import annotations

import multiprocessing
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import ablation
from benchmarks.ablation import (
    RULES,
    Numbers,
    Settings,
    Variant,
    ablate,
    constant_variants,
    constants,
    field_variants,
    rule_variants,
    table,
    worse_rows,
)
from dehyst.adaptive.online.gates import Judgement


def test_every_rule_replaces_what_is_there_and_every_variant_has_a_name_of_its_own() -> None:
    for rule in RULES:
        for owner, name, _ in rule.replaces:
            assert name in vars(owner), rule.name
        for text in rule.source:
            path = ablation.ROOT / "adaptive" / "online" / f"{text.module}.py"
            assert path.read_text().count(text.old) == 1, rule.name
        assert bool(rule.replaces) != bool(rule.source), rule.name
    assert len({variant.name for variant in (*rule_variants(), *field_variants())}) > 80


def test_a_copy_of_the_source_holds_the_shifted_constant(tmp_path: Path) -> None:
    variants = {variant.name: variant for variant in constant_variants()}
    assert len(variants) == 2 * len(list(constants())) > 60
    (literal,) = variants["step.ROLLBACK_S twice"].edits
    assert isinstance(literal, ablation.Literal)
    (tmp_path / literal.path).parent.mkdir(parents=True)
    before = (ablation.ROOT / literal.path).read_text().splitlines()
    (tmp_path / literal.path).write_text("\n".join(before))
    literal.replace_in(tmp_path)
    changed = [
        (old, new)
        for old, new in zip(before, (tmp_path / literal.path).read_text().splitlines(), strict=True)
        if old != new
    ]
    ((old, new),) = changed
    value = float(variants["step.ROLLBACK_S twice"].value)
    assert old.replace(repr(value), repr(2.0 * value)) == new


# ---- comparison


def case(value: float, **given: Any) -> Numbers:
    return {"median": value, "worst": value, "refused": 0.1, "large_s": 0.0, "unnamed": False} | given


NAMES = [f"c{i}" for i in range(8)]
BASE = {name: case(1.0) for name in NAMES}
#: What other noise does: a tenth, up and down.
REPEATED = [{name: case(1.1 if (i + k) % 2 else 1 / 1.1) for i, name in enumerate(NAMES)} for k in range(2)]


def rows(variant: dict[str, Numbers], comparisons: int = 1000) -> list[str]:
    return [str(row) for row in worse_rows(variant, BASE, REPEATED, {"sensor": NAMES}, comparisons)]


def test_a_row_is_worse_where_its_cases_grow_by_more_than_other_noise_does() -> None:
    grown = {name: case(1.0, worst=1.5) for name in NAMES}
    assert rows(grown) == ["sensor worst × 1.48"]
    # As much in one case only, or as other noise does, or equal.
    assert rows(BASE | {"c0": case(1.0, worst=100.0)}) == []
    assert rows(REPEATED[0]) == []
    assert rows(BASE) == []


# ---- the whole way, over made-up cases


@dataclass(frozen=True)
class DoubtCase:
    """The least size of a jump whose doubt is stated; and steps that are counted meanwhile."""

    name: str
    seed: int
    group: str = "intact"

    def run(self, noise: int, settings: Settings) -> Numbers:
        rng = np.random.default_rng([self.seed, noise])
        judgement = Judgement(1.0, 1.0, 1.0, 1.0)
        judgement.add_doubt(1.0 + 0.1 * rng.random())
        return {"median": 4.0 / judgement.doubt_V2 if judgement.doubt_V2 else 40.0, "worst": 1.0, "refused": 0.0,
                "large_s": 0.0, "accused": False}  # fmt: skip


@pytest.fixture
def cases() -> list[ablation.Case]:
    return [DoubtCase(f"stage {seed}", seed) for seed in range(8)]


def rule(name: str) -> Variant:
    return next(variant for variant in rule_variants() if variant.name == name)


def test_a_rule_that_matters_is_told_from_one_that_does_not(
    cases: list[ablation.Case], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    planned = [rule("doubt after a jump"), rule("jumps move the frame")]
    path, to = tmp_path / "a.jsonl", tmp_path / "table.md"
    results = ablate(cases, planned, jobs=2, path=path, to=to)
    assert [row.measure for row in results.worse("doubt after a jump")] == ["median"]
    assert "jumps move the frame: the same" in capsys.readouterr().err
    _, nothing, worth = to.read_text().split("###")
    assert nothing.startswith(" changes nothing, to the last bit (1)")
    assert worth.startswith(" worth its place (1)")
    assert "| doubt after a jump |" in worth
    assert table(results) + "\n" == to.read_text()

    again = ablate(cases, [*planned, rule("envelope refuses frames")], path=path)
    said = capsys.readouterr().err
    assert "doubt" not in said
    assert "envelope refuses frames: the same" in said
    assert again.worse("doubt after a jump") == results.worse("doubt after a jump")


class DyingCase(DoubtCase):
    """A case that ends its process when a rule is off."""

    def run(self, noise: int, settings: Settings) -> Numbers:
        if multiprocessing.parent_process() and not noise:
            os._exit(3)
        return super().run(noise, settings)


def test_a_variant_whose_process_ends_has_failed_in_all_cases_left(cases: list[ablation.Case]) -> None:
    dying = [*cases[:2], *(DyingCase(f"dies {seed}", seed) for seed in range(2))]
    results = ablate(dying, [rule("envelope refuses frames")])
    ended = [numbers.get("failed") for numbers in results.variants["envelope refuses frames"].values()]
    assert ended == [None, None, *["the process ended: 3"] * 2]
    assert [str(row) for row in results.worse("envelope refuses frames")] == ["intact failed +2"]
