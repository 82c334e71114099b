"""Abilities of online models are types: each model implements all of `OnlineModel`, and nobody asks by a string."""

from __future__ import annotations

import ast
import inspect
from pathlib import Path

import pytest

from dehyst.adaptive.online.learner import Learner
from dehyst.adaptive.types import InverseModel, OnlineModel
from dehyst.baselines.bouc_wen.online import BoucWenOnline
from dehyst.baselines.competition.competition import Competition
from dehyst.baselines.linear import LinearOnline
from dehyst.baselines.prandtl_ishlinskii.online import MpiOnline
from tests.online_models import PlainModel

ROOT = Path(__file__).resolve().parents[1]
ONLINE = (Learner, LinearOnline, MpiOnline, BoucWenOnline, Competition, PlainModel)
#: Set in the constructor of most models, and hence not visible in the class.
#: What only a Competition has; who calls it has asked for its class.
COMPETITION = {"standing", "champion_model", "reach"}
ATTRIBUTES = {"base", "seq", "trouble", "why", "distrusts"}


def members(protocol: type) -> dict[str, object]:
    return {name: value for name, value in vars(protocol).items() if not name.startswith("_")}


METHODS = {name: value for name, value in members(OnlineModel).items() if inspect.isfunction(value)}


@pytest.mark.parametrize("model", ONLINE, ids=lambda model: model.__name__)
def test_every_online_model_has_every_ability(model: type) -> None:
    """Renamed in one place only, a method is missing here, and has another signature there."""
    assert members(OnlineModel).keys() == METHODS.keys() | ATTRIBUTES
    missing = [name for name in METHODS if not callable(getattr(model, name, None))]
    assert not missing
    for name, method in METHODS.items():
        wanted, own = (list(inspect.signature(of).parameters) for of in (method, getattr(model, name)))
        assert own == wanted, name


def test_no_string_names_an_ability() -> None:
    """`getattr(x, "freeze", ...)` would go on without a word after a renaming."""
    known = members(OnlineModel).keys() | members(InverseModel).keys() | COMPETITION | {"from_state"}
    found = []
    for package in ("adaptive", "baselines", "sim", "service", "lab"):
        for path in (ROOT / package).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in (
                    "getattr", "hasattr", "setattr",
                ):  # fmt: skip
                    names = {part.value for part in ast.walk(node) if isinstance(part, ast.Constant)}
                    found += [f"{path.relative_to(ROOT)}:{node.lineno}: {name}" for name in names & known]
    assert not found
