"""Files as instruments write them: preambles, encodings, decimal commas, units in names, and all that is missing."""

from __future__ import annotations

import random
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from dehyst.adaptive.errors import InputError
from dehyst.sim.recordings import ColumnMap, Recording, read
from dehyst.sim.recordings.columns import MissingError, unit_of_name

N, DT_S = 300, 1e-3
T = np.arange(N) * DT_S
U = np.round(4.0 - 4.0 * np.cos(2 * np.pi * 5.0 * T), 4)
Y = np.round(10.0 * U + 0.5 * np.sin(2 * np.pi * 5.0 * T), 4)


def rows(*columns: np.ndarray, sep: str = ",") -> str:
    return "\n".join(sep.join(repr(round(float(value), 6)) for value in row) for row in zip(*columns, strict=True))


def same(recording: Recording, start_s: float = 0.0) -> None:
    np.testing.assert_allclose(recording.t_s, T + start_s, atol=1e-9)
    np.testing.assert_allclose(recording.u_V, U, atol=1e-6)
    np.testing.assert_allclose(recording.y_um, Y, atol=1e-6)


def german(text: str) -> str:
    return text.replace(".", ",")


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "latin-1"])
@pytest.mark.parametrize("sep", [";", "\t", ","])
def test_encodings_delimiters_and_units_in_names(tmp_path: Path, encoding: str, sep: str) -> None:
    body = rows(T * 1e3, U, Y, sep=sep)
    path = tmp_path / "a.txt"
    text = sep.join(["Zeit / ms", "Spannung [V]", "Weg (µm)"]) + "\n" + (body if sep == "," else german(body)) + "\n"
    path.write_bytes(text.encode(encoding))
    recording = read(path)
    same(recording)
    said = " ".join(recording.notes)
    assert ("decimal commas" in said) == (sep != ",")
    assert ("letters in" in said) == (encoding not in ("utf-8", "utf-8-sig"))
    assert "u is the column 'Spannung [V]', by its unit" in said


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("Voltage (V)", "V"), ("Voltage [mV]", "mV"), ("U / kV", "kV"), ("drive_V", "V"), ("Drive, Volts", "V"),
        ("drive in mV", "mV"), ("Voltage", None), ("V", None), ("Position (nm)", None), ("u (W)", None),
    ],
)  # fmt: skip
def test_units_of_a_voltage_in_names(name: str, unit: str | None) -> None:
    assert unit_of_name("u", name) == unit


TEKTRONIX = """Model,DPO3014
Firmware Version,2.38
,
Horizontal Units,s
Sample Interval,0.001
Record Length,300
Gating,0.0% to 100.0%
Probe Attenuation,1,1
Vertical Units,V,V
Vertical Scale,1,1
,
Label,,
TIME,CH1,CH2
"""


def tektronix(path: Path) -> None:
    path.write_text(TEKTRONIX + rows(T - 0.1, U, Y / 10))


def keysight(path: Path) -> None:
    path.write_text("x-axis,1,2\nsecond,Volt,Volt\n" + rows(T - 0.1, U, Y / 10))


def rigol(path: Path) -> None:
    lines = [f"{k},{u!r},{y / 10!r},," for k, (u, y) in enumerate(zip(U.tolist(), Y.tolist(), strict=True))]
    head = "X,CH1,CH2,Start,Increment,\nSequence,Volt,Volt,-1.0e-01,1.0e-03\n"
    path.write_text(head + "\n".join(lines))


@pytest.mark.parametrize("write", [tektronix, keysight, rigol])
def test_preambles_of_oscilloscopes(tmp_path: Path, write: Callable[[Path], None]) -> None:
    path = tmp_path / "scope.csv"
    write(path)
    names = ("1", "2") if write is keysight else ("CH1", "CH2")
    with pytest.raises(MissingError, match="2 things are missing") as caught:
        read(path)
    # The voltage's unit is in the file; the sensor's volts need a factor.
    assert caught.value.options == (f"--column u={names[0]}", f"--column y={names[1]}", "--scale y=FACTOR")
    recording = read(path, ColumnMap(columns={"u": names[0], "y": names[1]}, scale={"y": 10.0}))
    same(recording, 0.0 if write is rigol else -0.1)


def test_a_preamble_in_front_of_the_samples(tmp_path: Path) -> None:
    top = ["Record Length,300", "Sample Interval,0.001", "Vertical Units,V", "Horizontal Units,s"]
    lines = [f"{top[k] if k < len(top) else ','},,{t:.6f},{u:.6f}," for k, (t, u) in enumerate(zip(T, U, strict=True))]
    (tmp_path / "u.csv").write_text("\n".join(lines))
    (tmp_path / "y.csv").write_text("y_um\n" + rows(Y))
    same(read(tmp_path / "u.csv", ColumnMap(files={"y": tmp_path / "y.csv"})))


def test_all_that_is_missing_in_one_message(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("Time,Ch A,Ch B\n" + rows(T, U, Y))
    with pytest.raises(MissingError, match=r"(?s)Time, Ch A, Ch B.*3 things.*u_V.*y_um.*the time") as caught:
        read(path)
    options = caught.value.options
    assert options[:2] == ("--column 'u=Ch A'", "--unit u=UNIT")
    assert options[4:] == ("--column t=Time", "--unit t=UNIT")
    path.write_text("u_V,y_um\n" + rows(U, Y))
    with pytest.raises(MissingError) as caught:
        read(path)
    assert caught.value.options == ("--rate HZ",)
    # Without names the column that always rises may be the time.
    path.write_text(rows(T, U, Y))
    with pytest.raises(MissingError) as caught:
        read(path)
    assert "--column t=1" in caught.value.options
    # Two columns in volts: which one drives is never guessed.
    path.write_text("t (s),A (V),B (V)\n" + rows(T, U, Y))
    with pytest.raises(MissingError, match="u_V"):
        read(path)


def test_empty_cells_wrong_cells_and_a_last_line_that_is_cut_off(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    lines = rows(T, U, Y).splitlines()
    t, u, _ = lines[7].split(",")
    path.write_text("t_s,u_V,y_um\n" + "\n".join([*lines[:7], f"{t},{u},", *lines[8:], "0.3,1"]))
    recording = read(path)
    assert np.flatnonzero(np.isnan(recording.y_um)).tolist() == [7]
    assert any("is cut off and left out" in note for note in recording.notes)
    for wrong, message in ((f"{t},{u},ERR", "got 'ERR' in data row 8"), (f"{t},{u}", "line 9 has 2 cells")):
        path.write_text("t_s,u_V,y_um\n" + "\n".join([*lines[:7], wrong, *lines[8:]]))
        with pytest.raises(InputError, match=message):
            read(path)


def test_times_of_day_over_midnight(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    clock = [
        f"{(86399.9 + t) % 86400 // 3600:02.0f}:{(86399.9 + t) % 3600 // 60:02.0f}:{(86399.9 + t) % 60:09.6f}"
        for t in T
    ]
    path.write_text("time,u_V,y_um\n" + "\n".join(f"{c},{u},{y}" for c, u, y in zip(clock, U, Y, strict=True)))
    np.testing.assert_allclose(read(path).t_s, T, atol=2e-6)


# A refused file never ends the process.

DAMAGE = """
import random, sys
from pathlib import Path
from dehyst.adaptive.errors import InputError
from dehyst.sim.recordings import read

def damaged(rng):
    sep = rng.choice([",", ";", "\\t", " "])
    lines = [sep.join(f"{rng.random():.5f}" for _ in range(3)) for _ in range(rng.randrange(1, 1500))]
    for _ in range(rng.randrange(1, 4)):
        k = rng.randrange(len(lines))
        lines[k] = rng.choice([lines[k] + sep + "9", "ERR", sep, lines[k][:5], '"' + lines[k], "\\x00", ""])
    text = rng.choice(["t_s,u_V,y_um".replace(",", sep) + "\\n", "", "a\\n"]) + "\\n".join(lines)
    content = bytearray(text.encode())
    if rng.random() < 0.3:
        content[rng.randrange(len(content))] = rng.randrange(256)
    return bytes(content[: rng.randrange(1, len(content) + 1)])

path, first, count = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
refused = 0
for seed in range(first, first + count):
    path.write_bytes(damaged(random.Random(seed)))
    try:
        read(path)
    except InputError:
        refused += 1
print(refused)
"""


def run_damage(path: Path, first: int, count: int) -> int:
    done = subprocess.run(
        [sys.executable, "-c", DAMAGE, str(path), str(first), str(count)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return int(done.stdout)


def test_500_bad_files_in_one_process(tmp_path: Path) -> None:
    assert run_damage(tmp_path / "a.csv", 0, 500) > 250


def test_bad_files_in_a_process_each_that_ends_at_once(tmp_path: Path) -> None:
    seeds = random.Random(1).sample(range(1000, 100_000), 40)
    assert sum(run_damage(tmp_path / "a.csv", seed, 1) for seed in seeds) > 20


def test_no_thread_is_left_after_reading_text(tmp_path: Path) -> None:
    """The reader of pyarrow left threads that abort a process which ends at once; the present one starts none."""
    path = tmp_path / "a.csv"
    path.write_text("t_s,u_V,y_um\n" + rows(T, U, Y))
    code = (
        "import os, sys; from dehyst.sim.recordings import read\n"
        "from pathlib import Path; p = Path('/proc/self/task');\n"
        "before = len(list(p.iterdir())) if p.is_dir() else 0; read(sys.argv[1]);\n"
        "after = len(list(p.iterdir())) if p.is_dir() else 0; print(after - before, 'pyarrow' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["0", "False"]
