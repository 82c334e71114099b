"""The correction of answers to queries: whose readings count, what is left alone, and how it begins and ends."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from dehyst.adaptive.types import FloatArray, InverseModel
from dehyst.lab.loop import Asker, samples
from dehyst.service.client.client import Client
from dehyst.service.config.correction import CorrectionConfig
from dehyst.service.protocol.query import CORRECTED, FeedforwardQuery, Pending, flag_names
from dehyst.service.protocol.samples import encode_samples
from dehyst.service.runtime.session import open_client
from dehyst.service.server.axis import Axis
from dehyst.service.server.status import axis_fields
from tests.service.axes import loop_of
from tests.service.conftest import DT_S, ServeProcess
from tests.service.server.test_axis import make_axis

ON = CorrectionConfig(on=True, mode_Hz=200.0, fade_s=0.05)
#: The model states a deviation of 1 mV, so that 0.04 µm are its bound; the stage is off by less.
OFFSET_UM = 0.02
BLOCK = 5


def wanted(n: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A slow motion of 20 µm about 45 µm, and its derivatives."""
    w, t_s = 2.0 * math.pi, DT_S * np.arange(n)
    return 45.0 + 20.0 * np.sin(w * t_s), 20.0 * w * np.cos(w * t_s), -20.0 * w**2 * np.sin(w * t_s)


def ideal(axis: Axis, motion: tuple[FloatArray, FloatArray, FloatArray]) -> FloatArray:
    """(n,) voltages that the model asks for along ``motion``, from rest at its first place."""
    model = axis.model("lssvm_adaptive")[0]
    return model.feedforward(*motion, model.rest_memory(motion[0].item(0))).u_V


class Rig:
    """A stage that does what the model says, but ``OFFSET_UM`` above, and a controller that asks block by block."""

    def __init__(self, axis: Axis, n: int = 600) -> None:
        self.axis = axis
        self.ask = Asker(axis, "lssvm_adaptive")
        self.motion = wanted(n)
        self.ideal_V = ideal(axis, self.motion)
        self.slope = 10.0 / 110.0
        self.error_um, self.u_V, self.flags = np.zeros(n), np.zeros(n), np.zeros(n, dtype=np.uint8)

    def run(
        self,
        begin: int,
        end: int,
        read: Callable[[FloatArray], FloatArray] = lambda y_um: y_um,
        add_V: float = 0.0,
    ) -> None:
        """The blocks of samples ``begin`` to ``end``. read : the sensor. add_V : what the controller adds itself."""
        for first in range(begin, end, BLOCK):
            part = slice(first, first + BLOCK)
            y = self.motion[0][part]
            answer = self.ask(first, [column[part] for column in self.motion])
            self.flags[part] = answer.flags
            self.u_V[part] = answer.u_V + add_V
            self.error_um[part] = -OFFSET_UM - (self.u_V[part] - self.ideal_V[part]) / self.slope
            self.axis.handle(samples(first, DT_S, self.u_V[part], read(y - self.error_um[part])))


def axis_with(models: dict[str, InverseModel], config: CorrectionConfig = ON, **changes: Any) -> Axis:
    """An axis whose model does not learn."""
    return make_axis(models, **{"learn": "", "served": "lssvm_adaptive", "correction": config, **changes})


def test_an_offset_is_corrected_and_the_reply_and_the_status_say_so(models: dict[str, InverseModel]) -> None:
    rig, plain = Rig(axis_with(models)), Rig(axis_with(models, CorrectionConfig()))
    rig.run(0, 600)
    plain.run(0, 600)
    assert np.abs(rig.error_um[-100:]).max() < 0.02 * OFFSET_UM
    np.testing.assert_allclose(plain.error_um[100:], -OFFSET_UM, atol=0.2 * OFFSET_UM)
    assert not (plain.flags & CORRECTED).any()
    assert (rig.flags[100:] & CORRECTED).all()
    assert "corrected" in flag_names(int(rig.flags[-1]))
    status = axis_fields(loop_of(rig.axis))["corrected"]
    assert status["state"] == "corrects"
    assert status["u_V"] == pytest.approx(-OFFSET_UM * rig.slope, rel=0.02)
    assert status["gain_per_s"] > 1.0
    # The first reading of a block changes the next block's last voltage.
    assert status["age"] == 2 * BLOCK - 1
    assert axis_fields(loop_of(plain.axis))["corrected"] is None
    assert [event["event"] for event in rig.axis.take_events()] == ["correction_begun"]


def test_who_compares_gets_the_plain_answer_and_disturbs_nothing(models: dict[str, InverseModel]) -> None:
    rig, alone = Rig(axis_with(models)), Rig(axis_with(models))
    other = Asker(rig.axis, "linear")
    for first in range(0, 400, BLOCK):
        rig.run(first, first + BLOCK)
        alone.run(first, first + BLOCK)
        answer = other(first + BLOCK, [column[first + BLOCK : first + 2 * BLOCK] for column in rig.motion])
        assert not (answer.flags & CORRECTED).any() or first == 0
        query = FeedforwardQuery(*(column[:BLOCK] for column in rig.motion))
        assert not (rig.axis.answer(query).flags & CORRECTED).any()  # without what is under way
    np.testing.assert_array_equal(rig.u_V, alone.u_V)


def test_a_controller_that_corrects_by_itself_is_not_corrected_twice(models: dict[str, InverseModel]) -> None:
    rig = Rig(axis_with(models))
    rig.run(0, 300, add_V=0.1)
    assert not rig.flags.any()
    rig.run(300, 600)
    assert (rig.flags[-100:] & CORRECTED).all()


def test_doubted_readings_freeze_it_and_it_is_let_go(models: dict[str, InverseModel]) -> None:
    rig, plain = Rig(axis_with(models)), Rig(axis_with(models, CorrectionConfig()))
    sizes_V = []
    for begin, end in ((0, 400), (400, 440), (440, 560)):
        for one in (rig, plain):
            one.run(begin, end, read=(lambda y_um: y_um * math.nan) if begin else (lambda y_um: y_um))
        assert rig.axis.correction is not None
        sizes_V.append(rig.axis.correction.status()["u_V"])
    assert sizes_V[0] == pytest.approx(-OFFSET_UM * rig.slope, rel=0.02)
    assert sizes_V[1:] == [pytest.approx(sizes_V[0], rel=1e-3), 0.0]
    added_V = rig.u_V[400:560] - plain.u_V[400:560]
    assert np.abs(np.diff(added_V)).max() < 0.3 * abs(sizes_V[0])
    assert np.abs(added_V).max() < 1.5 * abs(sizes_V[0])


def test_a_named_trouble_lets_it_go_sample_by_sample(models: dict[str, InverseModel]) -> None:
    """A sensor that stands still, with a learner that finds it out: the stage is no worse off than without."""
    errors_um = []
    for config in (ON, CorrectionConfig()):
        rig = Rig(make_axis(models, served="lssvm_adaptive", correction=config), 1200)
        rig.run(0, 600)
        rig.run(600, 1200, read=lambda y_um: np.full_like(y_um, 45.0))
        errors_um.append(np.abs(rig.error_um[600:]))
        if config.on:
            assert rig.axis.correction is not None
            status = rig.axis.correction.status()
            assert status["state"] == f"let go: {rig.axis.newest.trouble}"
            assert rig.axis.newest.trouble
            assert status["u_V"] == 0.0
    assert errors_um[0].mean() < 1.05 * errors_um[1].mean()
    assert errors_um[0].max() < 1.05 * errors_um[1].max()


def test_after_a_restart_it_begins_from_zero_without_a_step(models: dict[str, InverseModel]) -> None:
    rig = Rig(axis_with(models))
    rig.run(0, 300)
    rig.axis = axis_with(models)
    rig.ask._axis = rig.axis  # the client goes on with what it has under way
    rig.run(300, 600)
    added_V = rig.u_V - rig.ideal_V
    assert np.abs(np.diff(added_V[295:305])).max() < 0.2 * abs(added_V[299])
    assert np.abs(rig.error_um[-50:]).max() < 0.05 * OFFSET_UM
    assert [event["event"] for event in rig.axis.take_events()] == ["correction_begun"]


def test_a_new_count_of_the_stage_begins_it_anew(models: dict[str, InverseModel]) -> None:
    rig = Rig(axis_with(models))
    rig.run(0, 300)
    assert rig.axis.correction is not None
    assert rig.axis.correction.status()["u_V"]
    rig.axis.correction.forget()
    assert rig.axis.correction.status() == {
        "state": "nobody is corrected", "u_V": 0.0, "gain_per_s": 0.0, "age": 0, "halved": 0, "doubted": 0,
    }  # fmt: skip


def test_samples_of_another_voltage_end_it(models: dict[str, InverseModel]) -> None:
    """Somebody else drives the stage: its readings say nothing of these answers."""
    rig = Rig(axis_with(models))
    rig.run(0, 300)
    for first in range(300, 340, BLOCK):
        part = slice(first, first + BLOCK)
        rig.ask(first, [column[part] for column in rig.motion])
        rig.axis.handle(samples(first, DT_S, rig.ideal_V[part] + 1.0, rig.motion[0][part] + 11.0))
    assert rig.axis.correction is not None
    assert rig.axis.correction.status()["u_V"] == 0.0


def test_it_keeps_the_limits(models: dict[str, InverseModel]) -> None:
    axis = axis_with(models)
    rig = Rig(axis)
    rig.run(0, 300)
    assert axis.correction is not None
    added_V = axis.correction.status()["u_V"]
    assert added_V < 0.0
    low_um = np.zeros(BLOCK)  # at the lower limit of the range, below 0 V
    answer = rig.ask(300, (low_um, low_um, low_um))
    assert answer.u_V.min() >= axis.limits.u_min_V
    assert np.abs(np.diff(answer.u_V)).max() <= axis.limits.slew_V_per_s * DT_S + 1e-12


def test_as_of_counts_for_the_readings_too(models: dict[str, InverseModel]) -> None:
    """The same questions get the same answers, whatever has come since."""

    def answers(more: int) -> FloatArray:
        axis, n = axis_with(models), 300
        motion, handled = wanted(n), 0
        u_V = ideal(axis, motion)
        for first in range(2 * BLOCK, n, BLOCK):
            seen = first - BLOCK + more
            axis.handle(samples(handled, DT_S, u_V[handled:seen], motion[0][handled:seen] + OFFSET_UM))
            handled = seen
            pending = Pending(0, motion[0][:first], u_V[:first].copy())
            asked = [column[first : first + BLOCK] for column in motion]
            got = axis.answer(FeedforwardQuery(*asked, as_of=first - BLOCK - 1, pending=pending))
            u_V[first : first + BLOCK] = got.u_V
        assert (got.flags & CORRECTED).all()
        return u_V

    np.testing.assert_array_equal(answers(0), answers(BLOCK))


#: A configuration's line for an axis whose queries are corrected.
_ON = "[axis.correction]\non = true\nmode_Hz = 200.0\nfade_s = 0.1"


@pytest.mark.e2e
def test_over_the_wire_the_error_falls_and_a_stuck_sensor_is_as_without(serve: Callable[..., ServeProcess]) -> None:
    """The same stage and motion, with and without: queries with ``begin``, in step with the samples by ``as_of``."""
    n, stuck = 1500, 1000
    y, v, a = wanted(n)
    # What the model cannot learn from the motion: the place wanders by itself.
    wander_um = 0.03 * np.sin(2.0 * math.pi * 3.7 * DT_S * np.arange(n))

    def errors_um(extra: str) -> tuple[float, FloatArray, dict[str, Any]]:
        process = serve(extra=extra)
        error_um = np.zeros(n)
        with Client.connect(process.endpoint, timeout_s=10.0) as client, open_client(process.endpoint) as session:
            put = session.declare_publisher(client.keys.sample)
            answer = None
            for first in range(0, n, BLOCK):
                part = slice(first, first + BLOCK)
                answer = client.trajectory(
                    y[part], v[part], a[part], after=answer, begin=first, as_of=first - 1, wait_s=10.0
                )
                true_um = 1.0 + 11.0 * answer.u_V + wander_um[part]
                error_um[part] = y[part] - true_um
                read_um = true_um if first < stuck else np.full(BLOCK, 45.0)
                k = np.arange(first, first + BLOCK)
                put.put(encode_samples(k, k * DT_S, answer.u_V, read_um))
            status = client.status()["corrected"]
        process.stop()
        return error_um, status

    (on_um, status), (off_um, nothing) = errors_um(_ON), errors_um("")
    assert nothing is None
    assert np.abs(on_um[300:stuck]).mean() < 0.8 * np.abs(off_um[300:stuck]).mean()
    assert np.abs(on_um[stuck:]).mean() < 1.05 * np.abs(off_um[stuck:]).mean()
    assert status["state"].startswith("let go: sensor_")
