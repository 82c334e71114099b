"""Delimited text as instruments and spreadsheets of many countries write it: opened at the first try."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dehyst.sim.recordings import Recording, read

N, DT_S = 600, 1e-3
T_S = np.arange(N) * DT_S
U_V = 4.0 - 4.0 * np.cos(2 * np.pi * 5.0 * T_S)
Y_UM = 9.0 * U_V + 0.8 * np.sin(2 * np.pi * 5.0 * T_S) + 1.0


def german(value: float) -> str:
    """With a decimal comma and points between thousands."""
    return f"{value:,.3f}".translate(str.maketrans(",.", ".,"))


def clock(t_s: float, decimal: str = ".") -> str:
    """A time of day that passes a full minute."""
    s = 36_000.0 + 359.7 + t_s
    return f"{int(s // 3600):02d}:{int(s // 60 % 60):02d}:{s % 60:06.3f}".replace(".", decimal)


def written(path: Path, head: str, row: str, encoding: str = "utf-8") -> Path:
    """A file with ``head`` and a row for each sample; ``row`` is formatted with k, t, u, y and their forms."""
    rows = "".join(
        row.format(
            k=k, t=t, u=u, y=y, t_de=german(1e3 * t), u_de=german(1e3 * u), y_de=german(1e3 * y),
            u_c=f"{u:.5f}".replace(".", ","), y_c=f"{y:.5f}".replace(".", ","), clock=clock(t), clock_c=clock(t, ","),
        )
        for k, (t, u, y) in enumerate(zip(T_S.tolist(), U_V.tolist(), Y_UM.tolist(), strict=True))
    )  # fmt: skip
    path.write_bytes((head + rows).encode(encoding))
    return path


def assert_read(recording: Recording, tolerance: float = 2e-5) -> None:
    assert recording.dt_s == pytest.approx(DT_S)
    np.testing.assert_allclose(recording.t_s - recording.t_s[0], T_S, atol=1e-9)
    np.testing.assert_allclose(recording.u_V, U_V, atol=tolerance)
    np.testing.assert_allclose(recording.y_um, Y_UM, atol=tolerance)


@pytest.mark.parametrize(
    ("head", "row", "encoding"),
    [
        ("Time (s)\tVoltage (V)\tPosition (µm)\r\n", "{t:.3f}\t{u:.5f}\t{y:.5f}\r\n", "utf-16"),
        ("Zeit [s];Spannung [V];Weg [µm]\r\n", "{t:.3f};{u:.5f};{y:.5f}\r\n", "latin-1"),
        ("t_s,u_V,y_um,\n", "{t:.3f},{u:.5f},{y:.5f},\n", "utf-8"),
        ("time,drive,sensor\ns,V,um\n", "{t:.3f},{u:.5f},{y:.5f}\n", "utf-8"),
        ("Setting;1;x\n" * 41 + "\nTime [s];Voltage [V];Position [µm]\n", "{t:.3f};{u:.5f};{y:.5f}\n", "utf-8"),
        ("sep=;\nTime/s;Voltage/V;Position/µm\n", "{t:.3f};{u:.5f};{y:.5f}\n", "utf-8"),
        ("Clock,Voltage (V),Position (um)\n", "{clock},{u:.5f},{y:.5f}\n", "utf-8"),
        ("Uhrzeit;Spannung in V;Weg in µm\n", "{clock_c};{u_c};{y_c}\n", "cp1252"),
        ("Time;Voltage (V);Position (um)\n", "01/23/2026 {clock} AM;{u:.5f};{y:.5f}\n", "utf-8"),
        ("Zeit;Spannung (V);Weg (um)\n", "23.01.2026 {clock};{u:.5f};{y:.5f}\n", "utf-8"),
    ],
)
def test_it_is_read_without_an_option(tmp_path: Path, head: str, row: str, encoding: str) -> None:
    assert_read(read(written(tmp_path / "r.csv", head, row, encoding)))


def test_points_between_thousands_are_left_out_and_said(tmp_path: Path) -> None:
    recording = read(written(tmp_path / "r.csv", "Zeit [ms];U [mV];Weg [nm]\n", "{t_de};{u_de};{y_de}\n"))
    assert_read(recording)
    assert any("thousands separated" in note for note in recording.notes)


@pytest.mark.parametrize("word", ["--", "OVRNG", "Overload", "-"])
def test_words_of_instruments_for_no_reading_are_missing_values(tmp_path: Path, word: str) -> None:
    path = written(tmp_path / "r.csv", "t (s),u (V),y (um)\r\n", "{t:.3f},{u:.5f},{y:.5f}\r\n")
    lines = path.read_text().splitlines()
    for k in (101, 301):
        lines[k] = ",".join([*lines[k].split(",")[:2], word])
    path.write_text("\n".join(lines))
    recording = read(path)
    assert np.flatnonzero(~np.isfinite(recording.y_um)).tolist() == [100, 300]
    assert np.isfinite(recording.u_V).all()


def test_afternoon_and_midnight(tmp_path: Path) -> None:
    """12 AM is midnight; the day that begins there is no step back."""
    seconds = 86_399.7 + T_S
    stamps = []
    for s in seconds % 86_400.0:
        hour = int(s // 3600)
        stamps.append(f"{hour % 12 or 12}:{int(s // 60 % 60):02d}:{s % 60:06.3f} {'PM' if hour >= 12 else 'AM'}")
    rows = "".join(f"{at},{u:.5f},{y:.5f}\n" for at, u, y in zip(stamps, U_V, Y_UM, strict=True))
    path = tmp_path / "r.csv"
    path.write_text("Time,Voltage (V),Position (um)\n" + rows)
    assert_read(read(path))
