"""The parts of the diagnosis in the background: buffer, alarm, configuration."""

from __future__ import annotations

from pathlib import Path

import pytest

from dehyst.service.background.settings import WatchConfig
from dehyst.service.config.settings import parse_config
from dehyst.service.protocol.errors import FieldError

DT_S = 1e-3


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
