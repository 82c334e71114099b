"""Adding a cause is adding one file: `cyclic_error` is simulated, named, drawn, reported and exported."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dehyst.adaptive.errors import InputError
from dehyst.service.reports.diagnosis_page import DIFFERENCES, Source, page
from dehyst.sim.diagnosis.catalogue import CATALOGUE
from dehyst.sim.diagnosis.diagnose import Options, diagnose
from dehyst.sim.diagnosis.export import export_stage
from dehyst.sim.diagnosis.result import Diagnosis, picture
from dehyst.sim.effects import CAUSES, EFFECTS, simulate
from dehyst.sim.fitting.fit_data import FitData
from dehyst.sim.pictures import WITH, WITHOUT
from tests.sim.diagnosis.cyclic_error import CYCLIC_ERROR
from tests.sim.diagnosis.test_diagnosis import DT, stage

RIPPLE = CYCLIC_ERROR(sine_um=0.03, cosine_um=-0.04, pitch_um=7.0)


@pytest.fixture(scope="module")
def data() -> FitData:
    return stage(RIPPLE, seed=8)


@pytest.fixture(scope="module")
def diagnosis(data: FitData) -> Diagnosis:
    return diagnose(data, options=Options(catalogue=CATALOGUE.with_kind(CYCLIC_ERROR)))


def test_it_is_named_with_its_numbers(diagnosis: Diagnosis) -> None:
    (cause,) = diagnosis.causes
    assert (diagnosis.verdict, cause.name) == ("effects", "cyclic_error")
    assert cause.parameters["pitch_um"] == pytest.approx(7.0, rel=0.01)
    assert cause.parameters["amplitude_um"] == pytest.approx(0.05, rel=0.1)
    assert cause.witness is not None
    assert cause.witness.seen is True
    assert diagnosis.extended_heldout_um < 1.2 * diagnosis.noise_floor_um


def test_it_is_drawn_and_reported(diagnosis: Diagnosis) -> None:
    shown = picture(diagnosis.causes[0], diagnosis.extended.model.data, diagnosis.catalogue)
    assert {curve.role for curve in shown.curves} == {WITHOUT, WITH}
    assert shown.x_name == "reading / µm"
    text = page(diagnosis, export_stage(diagnosis), Source("test"))
    assert "**cyclic error**" in text
    assert CYCLIC_ERROR.signature in text
    assert "hold zero" not in text


def test_the_page_says_that_the_size_is_open_where_all_intervals_hold_zero(diagnosis: Diagnosis) -> None:
    wide = {name: (-1.0, 99.0) for name in diagnosis.causes[0].parameters}
    unsure = replace(diagnosis, causes=(replace(diagnosis.causes[0], intervals=wide),))
    assert "intervals of all its numbers hold zero" in page(unsure, export_stage(unsure), Source("test"))


def test_the_page_does_not_say_below_the_bound_of_an_error_above_it(diagnosis: Diagnosis) -> None:
    def told(floors: float) -> str:
        floor = diagnosis.extended_heldout_um / floors
        bound = replace(diagnosis, noise_floor_um=floor, floor_source=DIFFERENCES)
        return page(bound, export_stage(bound), Source("test"))

    assert "below the only bound" in told(0.9)
    assert "near the only bound" in told(1.2)


def test_its_stage_moves_like_the_real_one(diagnosis: Diagnosis, data: FitData) -> None:
    exported = export_stage(diagnosis)
    assert exported.left_out == ()
    assert "cyclic_error" in exported.config.effects
    free_run = simulate(exported.config.effects, data.u_V, DT, other_um=diagnosis.extended.model.data.other_um)
    assert np.sqrt(np.mean(np.square(free_run - data.y_um))) < 0.02


def test_without_it_the_catalogue_leaves_most_of_the_error(data: FitData, diagnosis: Diagnosis) -> None:
    assert "cyclic_error" not in EFFECTS
    assert diagnose(data).extended_heldout_um > 3.0 * diagnosis.extended_heldout_um


def test_a_record_that_does_not_hold_it_does_not_name_it() -> None:
    healthy = diagnose(stage(seed=1), options=Options(catalogue=CATALOGUE.with_kind(CYCLIC_ERROR)))
    assert healthy.verdict == "adequate"
    assert "cyclic_error" not in healthy.not_excited


def test_a_catalogue_holds_each_effect_once_and_only_causes() -> None:
    with pytest.raises(InputError, match="cyclic_error"):
        CATALOGUE.with_kind(CYCLIC_ERROR).with_kind(CYCLIC_ERROR)
    with pytest.raises(InputError, match="bouc_wen"):
        CATALOGUE.with_kind(EFFECTS["bouc_wen"])


def test_one_side_of_a_pair_is_enough_to_say_that_they_look_the_same() -> None:
    assert CATALOGUE.same_set({"asymmetry"}) == CATALOGUE.same_set({"sensor_nonlinearity"})
    assert CATALOGUE.same_set({"creep"}) == {"creep"}


def test_search_and_export_know_no_cause_by_name() -> None:
    """What is particular about a cause stands in its file."""
    folder = Path(__file__).parents[3] / "sim" / "diagnosis"
    generic = [*(folder / "search").glob("*.py"), *(folder / f"{name}.py" for name in GENERIC)]
    for path in generic:
        text = path.read_text()
        assert not [name for name in CAUSES if f'"{name}"' in text], path
        assert "from sim.effects." not in text, path


#: Not `export` and `nominal`: a nominal stage is built of effects, which it must name.
GENERIC = ("catalogue", "diagnose", "next_experiment", "prepare", "result", "unexplained", "witnesses")


def test_every_cause_says_what_the_page_says_of_its_direct_test() -> None:
    """The table of docs/diagnosis.md is that of the catalogue."""
    text = (Path(__file__).parents[3] / "docs" / "diagnosis.md").read_text()
    table = text[text.index("## Direct tests") :].split("\n\n")[1].splitlines()[2:]
    rows = {
        name.strip(" `"): sign.strip()
        for row in table
        for names, sign in [row.strip("| ").split("|", 1)]
        for name in names.split(",")
    }
    assert rows == {name: cause.sign for name, cause in CATALOGUE.causes.items() if cause.sign}
    for name, cause in CATALOGUE.causes.items():
        assert bool(cause.sign) == bool(cause.tests or cause.in_readings), name


def test_the_page_says_how_much_an_alternative_removes(diagnosis: Diagnosis) -> None:
    either = replace(diagnosis.causes[0], alternatives=("sensor_nonlinearity",), instead={"sensor_nonlinearity": 0.83})
    text = page(replace(diagnosis, causes=(either,)), export_stage(diagnosis), Source("test"))
    assert "cannot tell it from sensor nonlinearity**: of what it removes, sensor nonlinearity removes 83 %" in text
