"""The parts of the diagnosis in the background: buffer, alarm, configuration."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dehyst.service.background.settings import WatchConfig
from dehyst.service.background.watcher import Alarm, Levels
from dehyst.service.config.settings import parse_config
from dehyst.service.protocol.errors import FieldError
from dehyst.service.protocol.samples import SampleBatch

DT_S = 1e-3


def batch(first: int, n: int, y_um: float = 1.0) -> SampleBatch:
    k = np.arange(first, first + n)
    return SampleBatch(k, k * DT_S, 0.1 * k, np.full(n, y_um))


# ---- alarm

NORMAL = Levels(1.0, 0.0, 0.05, True)


@pytest.mark.parametrize(
    ("now", "word"),
    [
        (NORMAL._replace(gain=0.985), "gain"),
        (NORMAL._replace(offset_V=0.3), "offset"),
        (NORMAL._replace(error_pct=1.0), "error"),
        (NORMAL._replace(valid=False), "validity"),
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
