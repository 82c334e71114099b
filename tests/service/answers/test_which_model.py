"""Which model answers: every row of both tables, the models that are kept, and the page that is drawn from them."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.online.sensor_trust import SENSOR_FAULTS
from dehyst.adaptive.state import restore, save
from dehyst.adaptive.types import FloatArray, InverseModel
from dehyst.service.answers.guard import Limits
from dehyst.service.answers.which_model import (
    MODELS,
    ROWS,
    RULES,
    Answering,
    ModelChoice,
    Seen,
    answering,
    page,
    rule_of,
)
from dehyst.service.client.follower import Follower
from dehyst.service.protocol.model import Safety, StandIn, encode_model
from tests.service.conftest import DT_S, make_models

DOCS = Path(__file__).resolve().parents[3] / "docs"
LIMITS = Limits(0.0, 10.0, 2000.0, 0.0, 90.0)
IDENTIFIED = make_models()["lssvm_adaptive"]
assert isinstance(IDENTIFIED, LssvmInverse)
#: Samples between two snapshots.
EVERY = 20

#: What is seen where each row is the first that holds.
SITUATIONS = {
    Answering.HELD: Seen(finite=False, weight=0.0, rival=True),
    Answering.STAND_IN: Seen("sensor_stuck", 0.0, rival=True),
    Answering.BLENDED: Seen("sensor_stuck", 0.3, frozen=True),
    Answering.RIVAL: Seen("sensor_stuck", rival=True, frozen=True),
    Answering.FROZEN: Seen("sensor_stuck", frozen=True, identified=True),
    Answering.IDENTIFIED: Seen("sensor_stuck", identified=True),
    Answering.LAST_GOOD: Seen("sensor_stuck"),
    Answering.LEARNT: Seen(),
}


def test_the_page_is_up_to_date() -> None:
    committed = (DOCS / "which_model.md").read_text(encoding="utf-8")
    assert committed == page(), "run: python -m dehyst.service.answers.which_model > docs/which_model.md"


def test_the_first_row_that_holds_says_which_model_answers() -> None:
    assert set(SITUATIONS) == set(Answering) == set(MODELS) == {row.answers for row in ROWS}
    assert {answers: answering(seen) for answers, seen in SITUATIONS.items()} == {one: one for one in Answering}


@pytest.mark.parametrize(
    ("trust", "trouble", "answers"),
    [(1.0, "", Answering.LEARNT), (1.0, "sensor_sign", Answering.LAST_GOOD),
     (0.5, "sensor_sign", Answering.BLENDED), (0.0, "sensor_sign", Answering.STAND_IN)],
)  # fmt: skip
def test_a_follower_says_it_of_its_last_voltage(trust: float, trouble: str, answers: Answering) -> None:
    stand_in = StandIn("linear", make_models()["linear"], np.empty(0))
    safety = Safety(blends=True, trust=trust, stand_in=stand_in, trouble=trouble)
    payload = encode_model("lssvm_adaptive", IDENTIFIED, 7, IDENTIFIED.rest_memory(40.0), safety)
    follower = Follower(None, None, "lssvm_adaptive", lambda: payload, LIMITS)
    follower.point(40.0)
    assert follower.answering is answers


def test_every_trouble_of_the_learner_has_a_rule_and_every_rule_is_on_both_pages() -> None:
    assert RULES.keys() >= SENSOR_FAULTS
    assert not any(rule_of(name).teaches for name in SENSOR_FAULTS)
    explained = (DOCS / "learner.md").read_text(encoding="utf-8").partition("### Troubles")[2]
    named = (DOCS / "protocol.md").read_text(encoding="utf-8")
    for trouble in RULES.keys() - {""}:
        assert re.search(rf"^\| `{trouble}`|^\| .*, `{trouble}`", explained, re.MULTILINE), trouble
        assert f"`{trouble}`" in named, trouble


def model(number: int) -> LssvmInverse:
    """The model of snapshot ``number``: it differs by as many thousandths of a volt."""
    beta = IDENTIFIED.beta.copy()
    beta[0] += 1e-3 * number
    return replace(IDENTIFIED, beta=beta)


class Life:
    """Snapshots one after the other; each brings another model."""

    def __init__(self) -> None:
        self.choice = ModelChoice(DT_S, LIMITS, last_good_s=2.0)
        self.number = 0
        self.newest: InverseModel | None = None

    def go(self, count: int, found: str = "", distrusts: bool = False, failed: bool = False) -> int:
        """``count`` snapshots; the number of the one that is served then."""
        for _ in range(count):
            self.number += 1
            self.newest = None if failed else model(self.number)
            good = self.choice.choose(self.number * EVERY, self.newest, IDENTIFIED, found, distrusts)
        assert isinstance(good, LssvmInverse)
        return round(1e3 * float(good.beta[0] - IDENTIFIED.beta[0]))


#: By trouble: how many snapshots of 0.02 s the served model is old when the trouble is named after 100 of them.
AGES = {
    **dict.fromkeys(("sensor_frozen", "samples_poisoned", *SENSOR_FAULTS), (25, 50)),
    "voltage_differs": (1, 1),
    "model_bad": (1, 1),
    "learner_failed": (1, 1),
    "nothing_learnt": (0, 1),
    "": (0, 0),
}


@pytest.mark.parametrize("trouble", RULES)
def test_each_trouble_serves_the_model_of_its_rule(trouble: str) -> None:
    life = Life()
    assert life.go(110) == 110
    served = life.go(1, trouble, failed=trouble == "learner_failed")
    least, most = AGES[trouble]
    assert least <= life.number - served <= most
    newest = life.go(10, trouble, failed=trouble == "learner_failed")
    # The newest is served on, or what was kept stays.
    assert newest == (life.number if not trouble else served)
    assert life.choice.trouble == trouble
    # It is over half a second after the last sign of it, and the newest is served again.
    life.go(24)
    assert life.choice.trouble == trouble
    assert life.go(1) == life.number
    assert life.choice.trouble == ""
    assert life.choice.rule == rule_of("")


def readings(of: InverseModel) -> FloatArray:
    """(4, n) of a stage whose inverse is ``of``."""
    t_s = 0.01 * np.arange(50)
    y_um = 45.0 + 30.0 * np.sin(2 * np.pi * 2.0 * t_s)
    v_um_per_s = np.gradient(y_um, 0.01)
    motion = np.stack((y_um, v_um_per_s, np.gradient(v_um_per_s, 0.01)))
    return np.vstack((motion, of.feedforward(*motion, of.rest_memory(float(y_um[0]))).u_V))


@pytest.mark.parametrize(("like", "served"), [(101, 101), (60, 75), (-200, 0)])
def test_while_nothing_is_learnt_the_model_with_the_smallest_error_on_the_readings_is_served(
    like: int, served: int
) -> None:
    """The newest, one from half a second to a second before, or the identified one."""
    life = Life()
    life.go(100)
    recent = readings(model(like))
    for number in range(101, 140):
        life.choice.choose(number * EVERY, model(number), IDENTIFIED, "nothing_learnt", recent=lambda: recent)
    good = life.choice.good
    assert isinstance(good, LssvmInverse)
    assert round(1e3 * float(good.beta[0] - IDENTIFIED.beta[0])) == pytest.approx(served, abs=25 if served == 75 else 0)
    assert life.choice.trouble == "nothing_learnt"


@pytest.mark.parametrize("trouble", ["sensor_stuck", "nothing_learnt", "learner_failed"])
def test_a_trouble_that_lasts_takes_the_trust_and_its_end_gives_it_back(trouble: str) -> None:
    life = Life()
    life.go(100)
    failed = trouble == "learner_failed"
    life.go(101, trouble, failed=failed)
    assert life.choice.trust == 1.0
    life.go(25, trouble, failed=failed)
    assert life.choice.trust == pytest.approx(0.5)
    life.go(30, trouble, failed=failed)
    assert life.choice.trust == 0.0
    life.go(80)
    assert life.choice.trust == 1.0


@pytest.mark.parametrize("trouble", ["", "nothing_learnt"])
def test_a_model_that_is_not_fit_is_served_during_no_trouble(trouble: str) -> None:
    """Also where the trouble lets the newest one answer."""
    life = Life()
    life.go(100)
    bad = replace(IDENTIFIED, beta=40.0 * IDENTIFIED.beta)
    good = life.choice.choose(101 * EVERY, bad, IDENTIFIED, trouble)
    assert good is not bad
    assert life.choice.trouble == "model_bad"


def test_a_state_goes_on_alike() -> None:
    life = Life()
    life.go(110)
    life.go(20, "sensor_stuck")
    other = Life()
    other.number = life.number
    restore(other.choice, save(life.choice))
    other.choice.keep(life.choice.models())
    assert [life.go(30), life.choice.trust] == [other.go(30), other.choice.trust]
