"""The restart benchmark at its smallest: it reports what is promised, and nothing that was told is lost.

No time is asserted: the machine that runs this may do anything else meanwhile.
"""

from __future__ import annotations

import sys

import pytest

from benchmarks.restart import main, page, restart


@pytest.mark.e2e
@pytest.mark.slow
def test_what_is_told_of_killed_services() -> None:
    """Real processes: killed twice, half a second of samples at 1 kHz before each."""
    report = restart(rounds=2, learn_s=0.5)
    assert report["rounds"] == 2
    for name in ("ready_s", "answered_s", "libraries_s", "ready_over_libraries"):
        assert len(report[name]) == 2
        assert min(report[name]) > 0.0
    for ready_s, answered_s, libraries_s, ratio in zip(
        report["ready_s"], report["answered_s"], report["libraries_s"], report["ready_over_libraries"], strict=True
    ):
        assert ready_s < answered_s
        assert ratio == pytest.approx(ready_s / libraries_s)
    # The journal is behind what was told by milliseconds; a second is what may be lost.
    assert max(report["unlearnt_ms"]) <= 1000.0
    assert report["records_lost"] == 0
    assert "until a client is answered" in page(report)


@pytest.mark.parametrize("options", [("--rounds", "0"), ("--learn", "0.1"), ("--learn", "nan")])
def test_what_cannot_be_measured_is_refused(
    options: tuple[str, str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["restart", *options])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    assert f"{options[0]}: got {options[1]}, expected" in capsys.readouterr().err
