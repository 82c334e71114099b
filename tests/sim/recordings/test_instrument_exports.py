"""Files as instruments write them: preambles, encodings, decimal commas, units in names, and all that is missing."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from dehyst.adaptive.errors import InputError
from dehyst.sim.recordings import ColumnMap, Recording, read
from dehyst.sim.recordings.columns import MissingError

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


@pytest.mark.parametrize(
    ("encoding", "sep"),
    [("utf-8", ","), ("utf-8-sig", ";"), ("utf-16", "\t"), ("latin-1", ";")],
)
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


def test_no_thread_is_left_after_reading_text(tmp_path: Path) -> None:
    """The reader of pyarrow left threads that abort a process which ends at once; text needs none of the libraries."""
    path = tmp_path / "a.csv"
    path.write_text("t_s,u_V,y_um\n" + rows(T, U, Y))
    code = (
        "import os, sys; from dehyst.sim.recordings import read\n"
        "from pathlib import Path; p = Path('/proc/self/task');\n"
        "before = len(list(p.iterdir())) if p.is_dir() else 0; read(sys.argv[1]);\n"
        "after = len(list(p.iterdir())) if p.is_dir() else 0\n"
        "print(after - before, {'pyarrow', 'h5py', 'nptdms', 'openpyxl'} & sys.modules.keys())"
    )
    done = subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["0", "set()"]


def test_options_read_what_a_header_says_in_words_of_its_own(tmp_path: Path) -> None:
    """An array file of a piezo controller, an export of an oscilloscope, and LabVIEW's text."""
    units = {"u": "V", "y": "um"}
    gcs = "# \n# VERSION = 1\n# SEPARATOR = 32\n# DIM = 2\n# SAMPLE_TIME = 0.001\n# NAME0 = Voltage\n# \n# END_HEADER\n"
    (tmp_path / "a.dat").write_text(gcs + rows(U, Y, sep=" "))
    same(read(tmp_path / "a.dat", ColumnMap(columns={"u": "1", "y": "2"}, units=units, dt_s=DT_S)))
    scope = "Model,DPO3014\nHorizontal Units,s\nSample Interval,0.001\nVertical Units,V,V\n,\nTIME,CH1,CH2\n"
    (tmp_path / "b.csv").write_text(scope + rows(T, U, Y))
    columns = {"t": "TIME", "u": "CH1", "y": "CH2"}
    same(read(tmp_path / "b.csv", ColumnMap(columns=columns, units={"t": "s", **units})))
    lvm = (
        "LabVIEW Measurement\t\nX_Columns\tOne\n***End_of_Header***\t\nChannels\t2\t\nX_Value\tdrive\tsensor\tComment\n"
    )
    (tmp_path / "c.lvm").write_text(lvm + rows(T, U, Y, sep="\t"))
    mapping = ColumnMap(columns={"t": "1", "u": "2", "y": "3"}, units={"t": "s", **units})
    same(read(tmp_path / "c.lvm", mapping))
