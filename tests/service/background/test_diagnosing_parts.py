"""The parts of the diagnosis in the background: buffer, alarm, configuration."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dehyst.service.background.settings import WatchConfig
from dehyst.service.background.watcher import Alarm, Levels, SampleBuffer
from dehyst.service.config.settings import parse_config
from dehyst.service.protocol.errors import FieldError
from dehyst.service.protocol.samples import SampleBatch

DT_S = 1e-3


def batch(first: int, n: int, y_um: float = 1.0) -> SampleBatch:
    k = np.arange(first, first + n)
    return SampleBatch(k, k * DT_S, 0.1 * k, np.full(n, y_um))


# ---- buffer


@pytest.mark.parametrize("sizes", [(3, 4, 5), (1,) * 20, (50,), (9, 10, 11)])
def test_the_buffer_keeps_the_newest_in_order(sizes: tuple[int, ...]) -> None:
    buffer, first = SampleBuffer(10), 0
    for n in sizes:
        assert buffer.add(batch(first, n))
        first += n
    kept = buffer.copy()
    assert kept[0].tolist() == list(range(max(0, first - 10), first))
    assert kept[2].tolist() == pytest.approx((0.1 * kept[0]).tolist())
    assert buffer.copy(4)[0].tolist() == kept[0, -4:].tolist()
    assert (buffer.size, buffer.last_seq) == (min(10, first), first - 1)


def test_doubles_are_left_out_and_a_restart_begins_anew() -> None:
    buffer = SampleBuffer(1000)
    buffer.add(batch(0, 500))
    assert buffer.add(batch(490, 20))
    assert buffer.copy()[0].tolist() == list(range(510))
    assert buffer.add(batch(0, 150))
    assert buffer.size == 510
    assert not buffer.add(batch(150, 150))
    assert buffer.copy()[0].tolist() == list(range(150, 300))


# ---- alarm

NORMAL = Levels(1.0, 0.0, 0.05, True)


@pytest.mark.parametrize(
    ("now", "word"),
    [
        (replace(NORMAL, gain=0.985), "gain"),
        (replace(NORMAL, offset_V=0.3), "offset"),
        (replace(NORMAL, error_pct=1.0), "error"),
        (replace(NORMAL, valid=False), "validity"),
    ],
)
def test_an_alarm_needs_to_last(now: Levels, word: str) -> None:
    alarm = Alarm(WatchConfig(), 10.0)
    assert alarm.check(0.0, now) == ""
    alarm.arm(NORMAL)
    assert alarm.check(1.0, now) == ""
    assert alarm.check(1.4, NORMAL) == ""
    assert alarm.check(1.6, now) == ""
    assert word in alarm.check(2.1, now)


def test_what_stays_within_its_bounds_raises_none() -> None:
    alarm = Alarm(WatchConfig(), 10.0)
    alarm.arm(NORMAL)
    assert all(alarm.check(0.1 * k, Levels(1.009, 0.19, 0.19, True)) == "" for k in range(100))
    assert Levels.of({"gain": float("nan"), "offset_V": 0.0, "recent_rms_error_pct": 1.0}) is None
    assert Levels.of({"gain": 1.0}) is None


# ---- configuration


def test_the_configuration_is_read_strictly() -> None:
    text = 'stage = "demo"\n[[axis]]\nname = "x"\nmodel = "x.npz"\nu_min_V = 0\nu_max_V = 9\nslew_V_per_s = 1\n'
    read = parse_config(text + '[axis.diagnosis]\ncollect_s = 3\nreports = "r"\n', "here", Path("/a"))
    assert read.axes[0].diagnosis.collect_s == 3.0
    assert read.axes[0].diagnosis.reports == "/a/r"
    assert parse_config(text, "here", Path()).axes[0].diagnosis == WatchConfig()
    for line, word in (("colect_s = 3", "colect_s"), ("timeout_s = 0", "timeout_s"), ("history_s = 3", "history_s")):
        with pytest.raises(FieldError, match=word):
            parse_config(text + f"[axis.diagnosis]\n{line}\n", "here", Path())
