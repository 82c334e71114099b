"""Exports as programs write them: read as they are, or by the options that the first message proposes."""

from __future__ import annotations

import argparse
import gzip
import json
import os
import shlex
from collections.abc import Callable
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import openpyxl
import pyarrow as pa
import pytest
from pyarrow import feather
from scipy.io import savemat

from dehyst.adaptive.errors import InputError
from dehyst.service.identification.recording_options import add_mapping_arguments, mapping_from
from dehyst.sim.recordings import Recording, read
from dehyst.sim.recordings.columns import ColumnMap, MissingError

N, DT_S = 1500, 1e-3
T_S = np.arange(N) * DT_S
U_V = 5.0 - 4.5 * np.cos(2 * np.pi * 1.3 * T_S)
# The displacement lags the voltage, as in a stage.
Y_UM = 8.0 * U_V - 1.5 * np.sin(2 * np.pi * 1.3 * T_S) + 3.0
RECORDS = np.zeros(N, dtype=[("time", "f8"), ("voltage_V", "f8"), ("pos_nm", "f8")])
RECORDS["time"], RECORDS["voltage_V"], RECORDS["pos_nm"] = T_S, U_V, 1e3 * Y_UM


def second_try(path: Path, filled: dict[str, str] | None = None) -> tuple[Recording, int]:
    """The recording, and the tries that it took: 2 with the options of the first message, ``filled`` in by the user."""
    try:
        return read(path), 1
    except MissingError as error:
        options = shlex.split(" ".join(error.options))
    for word, value in {"u=UNIT": "u=V", "y=UNIT": "y=um", "t=UNIT": "t=s", **(filled or {})}.items():
        options = [
            f"{option.removesuffix(word)}{value}" if option.endswith(f"={word}") or option == word else option
            for option in options
        ]
    parser = argparse.ArgumentParser()
    add_mapping_arguments(parser)
    return read(path, mapping_from(parser.parse_args(options))), 2


def assert_read(recording: Recording, y_um: np.ndarray[Any, Any] = Y_UM, tolerance: float = 1e-3) -> None:
    assert recording.dt_s == pytest.approx(DT_S)
    np.testing.assert_allclose(recording.u_V, U_V, atol=tolerance)
    np.testing.assert_allclose(recording.y_um, y_um, atol=10 * tolerance)


def rows(line: str) -> str:
    """A line for each sample: k, t, u, y in the canonical units, v the sensor at 10 µm per V, and times."""
    start = datetime(2026, 11, 25, 14, 3, 11)
    return "".join(
        line.format(
            k=k, k3=(k % 777) / 9, t=t, u=u, y=y, v=y / 10, ms=1e3 * t,
            iso=(start + timedelta(milliseconds=k)).isoformat("T", "milliseconds"),
            clock=(start + timedelta(milliseconds=k)).strftime("%d.%m.%Y %H:%M:%S.%f"),
            days=46_000.5 + t / 86_400, day=f"11/25/2026 14:00:{int(t):02d}", rest=k % 1000, u_mV=1e3 * u, y_nm=1e3 * y,
        )
        for k, (t, u, y) in enumerate(zip(T_S.tolist(), U_V.tolist(), Y_UM.tolist(), strict=True))
    )  # fmt: skip


def commas(text: str) -> str:
    return text.replace(".", ",")


TWINCAT = """Name\tYT Scope Project
File\tC:\\lab.tcscopex

Name\tGVL.fU\tName\tGVL.fY
Data-Type\tREAL64\tData-Type\tREAL64
SampleTime[ms]\t1\tSampleTime[ms]\t1
Unit\t(None)\tUnit\t(None)

"""
LABVIEW = """waveform\t[0]\t[1]
t0\t25.11.2026 14:03:11,000000\t25.11.2026 14:03:11,000000
delta t\t0,001000\t0,001000

time\tY[0]\tY[1]
"""
BENCHLINK = "Name:,scan1\nOwner:,lab\nScan,Time,101 <u> (VDC),101 Alarm,102 <y> (VDC),102 Alarm\n"
LONG = "[Settings]\n" + "".join(f"Parameter{k}={k / 2}\n" for k in range(600)) + "[Data]\n"

#: Opened as they are.
PLAIN: dict[str, tuple[str, str]] = {
    "units in odd words": ("Time (msec),Drive Voltage [Volts],Position (Mikrometer)\n", "{ms:.3f},{u:.5f},{y:.5f}\n"),
    "units behind colons": ("Time: s,Voltage: V,Position: um\n", "{t:.3f},{u:.5f},{y:.5f}\n"),
    "bars": ("t_s|u_V|y_um\n", "{t:.3f}|{u:.5f}|{y:.5f}\n"),
    "times with a zone": ("time,u_V,y_um\n", "{iso}+01:00,{u:.5f},{y:.5f}\n"),
    "a preamble of 602 lines": (LONG + "Time[s]\tU[V]\tX[um]\n", "{t:.3f}\t{u:.5f}\t{y:.5f}\n"),
    "names with blanks in fixed columns": (
        "  Time (s)     Voltage (V)    Position (um)\n", "   {t:.3f}   {u:9.5f}   {y:9.5f}\n",
    ),
    "thousands in quotes": ("Time (ms),Voltage (mV),Position (nm)\n", '"{ms:,.1f}","{u_mV:,.2f}","{y_nm:,.1f}"\n'),
}  # fmt: skip


@pytest.mark.parametrize("name", PLAIN)
def test_text_that_opens_at_once(tmp_path: Path, name: str) -> None:
    head, line = PLAIN[name]
    (tmp_path / "a.csv").write_text(head + rows(line), encoding="utf-8")
    recording, _ = second_try(tmp_path / "a.csv")
    assert_read(recording)


def test_names_and_units_above_other_rows_are_read_where_the_user_states_their_line(tmp_path: Path) -> None:
    head = "HBM\n\nZeit\tSpannung\tWeg\ns\tV\tµm\n25.11.2026\t25.11.2026\t25.11.2026\n1 kHz\t1 kHz\t1 kHz\n"
    (tmp_path / "a.csv").write_text(head + rows("{t:.3f}\t{u:.5f}\t{y:.5f}\n"), encoding="utf-8")
    assert_read(read(tmp_path / "a.csv", ColumnMap(header="3")))


def test_decimal_commas_in_quotes_between_commas(tmp_path: Path) -> None:
    body = "".join(
        ",".join(f'"{value:.5f}"'.replace(".", ",") for value in row) + "\n"
        for row in zip(T_S.tolist(), U_V.tolist(), Y_UM.tolist(), strict=True)
    )
    (tmp_path / "a.csv").write_text('"Zeit [s]","Spannung [V]","Weg [µm]"\n' + body, encoding="utf-8")
    assert_read(read(tmp_path / "a.csv"))


@pytest.mark.parametrize("sign", ["\u00a0", "\u202f", "'"])
def test_thousands_of_other_countries(tmp_path: Path, sign: str) -> None:
    body = rows("{ms:,.1f};{u_mV:,.2f};{y_nm:,.1f}\n").replace(",", sign).replace(".", ",")
    (tmp_path / "a.csv").write_text("Temps (ms);Tension (mV);Position (nm)\n" + body, encoding="utf-8")
    recording = read(tmp_path / "a.csv")
    assert_read(recording)
    assert any("thousands separated" in note for note in recording.notes)


def test_decimal_commas_between_commas_are_refused_with_what_to_do(tmp_path: Path) -> None:
    body = rows("{t:.3f};{u:.5f};{y:.5f}\n").replace(".", ",").replace(";", ",")
    (tmp_path / "a.csv").write_text("Zeit,Spannung,Weg\n" + body)
    with pytest.raises(InputError, match=r"3 names and 6 cells a line.*save it with ';'"):
        read(tmp_path / "a.csv")


#: Opened at the second try: the head, a row, and what the user fills in.
SCOPES: dict[str, tuple[str, str, dict[str, str]]] = {
    "volts of the sensor in the name": ("Time(s),CH1(V),CH2(V)\n", "{t:.6e},{u:.5e},{v:.6e}\n", {"FACTOR": "10"}),
    "increment in the line of names": (
        "CH1(V),CH2(V),t0 = -5.0e-03, tInc = 1.000000e-03,\n", "{u:.5e},{v:.6e},,\n", {"FACTOR": "10", "HZ": "1000"},
    ),
    "Keysight": ("x-axis,1,2\nsecond,Volt,Volt\n", "{t:.6e},{u:.5e},{v:.6e}\n", {"FACTOR": "10"}),
    "TwinCAT": (TWINCAT, "{k}\t{u:.6f}\t{k}\t{y:.6f}\n", {"HZ": "1000"}),
    "LabVIEW's waveforms": (LABVIEW, commas("{clock}\t{u:.6f}\t{y:.6f}\n").replace(":,", ":."), {}),
    "BenchLink": (BENCHLINK, "{k},{day}:{rest:03d},{u:.5E},0,{v:.6E},0\n", {"FACTOR": "10"}),
    "a counter in place of a time": ("Sample,U (V),Y (um)\n", "{k},{u:.5f},{y:.5f}\n", {"HZ": "1000"}),
    "a time in ms without a unit": ("Time,Drive (V),Sensor (um)\n", "{ms:.1f},{u:.5f},{y:.5f}\n", {"t=UNIT": "t=ms"}),
}  # fmt: skip


@pytest.mark.parametrize("name", SCOPES)
def test_exports_that_open_at_the_second_try(tmp_path: Path, name: str) -> None:
    head, line, filled = SCOPES[name]
    body = rows(line)
    if name.startswith("LabVIEW"):
        body = body.replace(".", ",").replace("25,11,2026", "25.11.2026")
    (tmp_path / "a.csv").write_text(head + body, encoding="utf-8")
    recording, _ = second_try(tmp_path / "a.csv", filled)
    assert_read(recording)


def struct_array(**fields: list[Any]) -> Any:
    n = len(next(iter(fields.values())))
    array = np.zeros((1, n), dtype=[(name, "O") for name in fields])
    for k in range(n):
        array[0, k] = tuple(values[k] for values in fields.values())
    return array


def simulink(path: Path) -> None:
    signals = struct_array(values=[U_V[:, None], Y_UM[:, None]], label=["u", "y"])
    savemat(path, {"ScopeData": {"time": T_S[:, None], "signals": signals, "blockName": "m/Scope"}})


def cells(path: Path) -> None:
    data = np.empty((1, 2), dtype=object)
    data[0, 0], data[0, 1] = U_V[:, None], Y_UM[:, None]
    savemat(path, {"t": T_S, "data": data})


def write_v73(path: Path, build: Callable[[h5py.File], None]) -> None:
    with h5py.File(path, "w", userblock_size=512) as file:
        build(file)
    with path.open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64, HDF5 schema 1.00 .".ljust(116) + bytes(8) + b"\x00\x02IM")


def put(group: h5py.Group, name: str, values: Any) -> h5py.Dataset:
    stored = group.create_dataset(name, data=np.asarray(values, dtype=np.float64).reshape(1, -1))
    stored.attrs["MATLAB_class"] = np.bytes_("double")
    return stored


def v73_with_references(path: Path) -> None:
    def build(file: h5py.File) -> None:
        store = file.create_group("#refs#")
        values = [put(store, "a", U_V), put(store, "b", Y_UM)]
        scope = file.create_group("scope")
        scope.attrs["MATLAB_class"] = np.bytes_("struct")
        put(scope, "time", T_S)
        put(scope, "fs", [1000.0])
        signals = scope.create_group("signals")
        signals.attrs["MATLAB_class"] = np.bytes_("struct")
        field = signals.create_dataset("values", (1, 2), dtype=h5py.ref_dtype)
        field[0, 0], field[0, 1] = values[0].ref, values[1].ref

    write_v73(path, build)


def v73_cells(path: Path) -> None:
    def build(file: h5py.File) -> None:
        store = file.create_group("#refs#")
        values = [put(store, "a", U_V), put(store, "b", Y_UM)]
        put(file, "t", T_S)
        data = file.create_dataset("data", (1, 2), dtype=h5py.ref_dtype)
        data.attrs["MATLAB_class"] = np.bytes_("cell")
        data[0, 0], data[0, 1] = values[0].ref, values[1].ref

    write_v73(path, build)


def records(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["rec"] = RECORDS


def with_object(path: Path) -> None:
    np.savez(path, t=T_S, u=U_V, y=Y_UM, meta=np.array({"stage": 7}, dtype=object))


def feather_file(path: Path) -> None:
    feather.write_feather(pa.table({"t_s": T_S, "u_V": U_V, "y_um": Y_UM}), str(path))


def workbook(path: Path, rows_of: list[list[Any]], notes: str = "") -> None:
    book = openpyxl.Workbook()
    sheet = book.active
    if notes:
        sheet.append([notes])
        sheet = book.create_sheet("Data")
    for row in rows_of:
        sheet.append(row)
    book.save(path)


TABLE = np.stack([T_S, U_V, Y_UM], axis=1).tolist()
NAMES = ["Time (s)", "Voltage (V)", "Position (µm)"]
BINARY: dict[str, Callable[[Path], None]] = {
    "n2.npy": lambda path: np.save(path, np.stack([T_S, U_V, Y_UM], axis=1)),
    "object.npz": with_object,
    "scope.mat": simulink,
    "cells.mat": cells,
    "references.mat": v73_with_references,
    "cells73.mat": v73_cells,
    "records.h5": records,
    "a.feather": feather_file,
    "title.xlsx": lambda path: workbook(path, [["Measurement of stage 7"], [], NAMES, *TABLE]),
    "units.xlsx": lambda path: workbook(
        path, [["Stage 7", "25.11.2026"], [None], ["Time", "Voltage", "Position"], ["s", "V", "µm"], *TABLE]
    ),
    "texts.xlsx": lambda path: workbook(path, [NAMES, *([commas(f"{v:.6f}") for v in row] for row in TABLE)]),
    "times.xlsx": lambda path: workbook(
        path,
        [
            ["Clock", *NAMES[1:]],
            *([(datetime(2026, 1, 1, 14) + timedelta(seconds=t)).time(), u, y] for t, u, y in TABLE),
        ],
    ),
}


@pytest.mark.parametrize("name", BINARY)
def test_files_of_programs_that_open_at_the_second_try(tmp_path: Path, name: str) -> None:
    BINARY[name](tmp_path / name)
    recording, _ = second_try(tmp_path / name)
    assert_read(recording)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.csv.gz", gzip.compress(b"t_s,u_V,y_um\n" * 999, mtime=0)[:-9], "is not a whole gzip file"),
        ("a.csv", b"\x1f\x8b\x08" + bytes(100), "is not a whole gzip file"),
        ("a.csv", b"%PDF-1.4\n" + bytes(100), "is a PDF"),
        ("a.csv", b"<!DOCTYPE html><html></html>\n", "is a web page"),
        ("a.csv", b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(100), "an old Office file"),
        ("a.isf", b":WFMPRE:BYT_NR 2;:CURVE #46000" + bytes(100), "own waveform file: export it as .csv"),
        ("a.json", b'{"t_s": [0.0, 1.0', "is not whole JSON"),
        ("a.json", b"[" * 100_000, "is not whole JSON"),
        ("a.json", b'{"stage": "7", "date": [2026, [11], "x"]}', "holds no arrays of numbers"),
    ],
)
def test_a_refused_file_is_called_what_it_is(tmp_path: Path, name: str, content: bytes, message: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=message):
        read(tmp_path / name)


def test_a_unit_of_another_kind_asks_for_a_factor_and_an_option_overrides_it(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("t_s,u_V,sensor (V)\n" + rows("{t:.3f},{u:.5f},{v:.6f}\n"))
    with pytest.raises(MissingError, match="is in V by its name") as caught:
        read(tmp_path / "a.csv", ColumnMap(columns={"y": "sensor (V)"}))
    assert caught.value.options == ("--scale y=FACTOR",)
    assert_read(read(tmp_path / "a.csv", ColumnMap(columns={"y": "sensor (V)"}, units={"y": "um"})), Y_UM / 10)


#: Columns of which some were proposed wrongly, a line of them, and the names of the voltage's and the sensor's.
PROPOSED: dict[str, tuple[str, str, tuple[str, str]]] = {
    "a target": (
        "Target Position,Control Voltage,Current Position\n", "{k3:.3f},{u:.5f},{y:.5f}\n",
        ("Control Voltage", "Current Position"),
    ),
    "a unit of another kind": ("t (s),U (V),Sensor (counts)\n", "{t:.3f},{u:.5f},{v:.6f}\n", ("", "Sensor (counts)")),
    "the phase of an amplifier": ("t (s),U (V),Phase (deg),A\n", "{t:.3f},{u:.5f},{k3:.3f},{y:.5f}\n", ("", "A")),
    "channels the other way round": ("t (s),ch1,ch2\n", "{t:.3f},{y:.5f},{u:.5f}\n", ("ch2", "ch1")),
    "the plant's input and output": ("t (s),output,input\n", "{t:.3f},{y:.5f},{u:.5f}\n", ("input", "output")),
    "two copies of a sensor": ("t (s),A,B,C\n", "{t:.3f},{y:.5f},{y:.5f},{u:.5f}\n", ("C", "A")),
    "a sensor in volts and in um": (
        "t (s),Sensor (V),Sensor (um),HV\n", "{t:.3f},{v:.6f},{y:.5f},{u:.5f}\n", ("HV", ""),
    ),
    "counts": ("t (s),dac_counts,adc_counts\n", "{t:.3f},{u:.5f},{v:.6f}\n", ("dac_counts", "adc_counts")),
    "a displacement alone": ("x [s],y [m]\n", "{t:.3f},{v:.6f}\n", ("", "")),
}  # fmt: skip


@pytest.mark.parametrize("name", PROPOSED)
def test_no_proposal_is_wrong(tmp_path: Path, name: str) -> None:
    head, line, expected = PROPOSED[name]
    (tmp_path / "a.csv").write_text(head + rows(line))
    with pytest.raises(MissingError) as caught:
        read(tmp_path / "a.csv")
    options = [tuple(shlex.split(option)) for option in caught.value.options]
    columns = dict(value.split("=") for option, value in options if option == "--column")
    assert (columns.get("u", ""), columns.get("y", "")) == expected
    # A unit that is written nowhere is asked for, and one of another kind needs a factor.
    units = [value for option, value in options if option in ("--unit", "--scale")]
    assert all(value.endswith(("=UNIT", "=FACTOR")) for value in units)
    assert ("y=FACTOR" in units) == (name in ("counts", "a unit of another kind"))


@pytest.mark.parametrize(
    ("unit", "factor"), [("urad", 1.0), ("mrad", 1e3), ("rad", 1e6), ("arcsec", 4.84813681), ("deg", 17453.2925)]
)
def test_a_tilt_is_read_in_microradians_and_says_so(tmp_path: Path, unit: str, factor: float) -> None:
    tilt = Y_UM / factor
    body = "".join(f"{t:.3f},{u:.5f},{y:.12f}\n" for t, u, y in zip(T_S, U_V, tilt, strict=True))
    (tmp_path / "a.csv").write_text(f"Time (s),Drive (V),Tilt ({unit})\n{body}")
    recording = read(tmp_path / "a.csv")
    assert_read(recording)
    assert recording.y_unit == "µrad"
    assert any("y is an angle: µrad stand where µm is written" in note for note in recording.notes)
    (tmp_path / "b.csv").write_text(f"Time (s),Drive (V),A\n{body}")
    assert_read(second_try(tmp_path / "b.csv", {"y=UNIT": f"y={unit}"})[0])


def test_the_days_of_a_spreadsheet_are_a_time(tmp_path: Path) -> None:
    book = openpyxl.Workbook()
    book.active.append(["Date", "Drive", "Sensor"])
    for t, u, y in zip(T_S.tolist(), U_V.tolist(), Y_UM.tolist(), strict=True):
        book.active.append([46_000.5 + t / 86_400, u, y])
    book.save(tmp_path / "a.xlsx")
    recording, tries = second_try(tmp_path / "a.xlsx", {"t=UNIT": "t=day"})
    assert tries == 2
    assert_read(recording)


def test_a_packed_text_and_a_packed_binary_file(tmp_path: Path) -> None:
    with gzip.open(tmp_path / "a.csv.gz", "wt") as file:
        file.write("t_s,u_V,y_um\n" + rows("{t:.3f},{u:.5f},{y:.5f}\n"))
    assert_read(read(tmp_path / "a.csv.gz"))
    np.savez(tmp_path / "a.npz", t_s=T_S, u_V=U_V, y_um=Y_UM)
    (tmp_path / "b.npz.gz").write_bytes(gzip.compress((tmp_path / "a.npz").read_bytes()))
    assert_read(read(tmp_path / "b.npz.gz"))


def archived(name: str, unit: str, values: Any) -> dict[str, Any]:
    stamps = [{"secs": 1_764_300_000 + k // 1000, "nanos": k % 1000 * 1_000_000} for k in range(N)]
    return {"meta": {"name": name, "EGU": unit}, "data": [{**s, "val": v} for s, v in zip(stamps, values, strict=True)]}


JSON: dict[str, Any] = {
    "arrays": {"t_s": T_S.tolist(), "u_V": U_V.tolist(), "y_um": Y_UM.tolist(), "stage": "7"},
    "arrays with units": {
        "rate": {"value": 1},
        "time": {"unit": "ms", "values": (1e3 * T_S).tolist()},
        "drive": {"units": "V", "values": U_V.tolist()},
        "sensor": {"unit": "nm", "values": (1e3 * Y_UM).tolist()},
    },
    "records": [{"t_s": t, "u_V": u, "y_um": y} for t, u, y in TABLE],
    "an archive": [archived("PZ:VOLT", "V", U_V.tolist()), archived("PZ:POS", "um", Y_UM.tolist())],
}


@pytest.mark.parametrize("name", JSON)
def test_json_of_arrays(tmp_path: Path, name: str) -> None:
    (tmp_path / "a.json").write_text(json.dumps(JSON[name]))
    assert_read(read(tmp_path / "a.json"))


def test_a_file_without_arrays_is_refused_with_what_to_do(tmp_path: Path) -> None:
    def build(file: h5py.File) -> None:
        stored = file.create_dataset("TT", data=np.zeros((1, 6), dtype=np.uint32))
        stored.attrs["MATLAB_class"] = np.bytes_("timetable")

    write_v73(tmp_path / "a.mat", build)
    with pytest.raises(
        InputError, match=r"no arrays of numbers.*TT \(a timetable: in MATLAB, writetimetable\(TT, 'TT.csv"
    ):
        read(tmp_path / "a.mat")


AWKWARD = Path(os.environ.get("DEHYST_DATA", "../shared/data")) / "awkward"
#: File -> what the user states; nothing where the file states it all.
EXPORTS = {
    "03_lecroy_C1--stage--00000.csv": "--column u=Ampl --unit u=V --column t=Time --unit t=s"
    " --file y=03_lecroy_C2--stage--00000.csv --column y=Ampl --scale y=10",
    "04_tds_F0001CH1.csv": "--column u=5 --unit u=V --column t=4 --unit t=s"
    " --file y=04_tds_F0001CH2.csv --column y=5 --scale y=10",
    "05_pi_gcs.dat": "--column u=3 --unit u=V --column y=2 --unit y=um --rate 1000",
    "07_igor.itx": "--column u=2 --unit u=V --column y=3 --unit y=m --rate 1000",
    "10_archiver.json": "",
    "17_thousands.csv": "",
    "23_counts.csv": "--column u=dac_counts --scale u=0.00152588"
    " --column y=adc_counts --scale y=0.00152588 --rate 1000",
    "25_mrad.csv": "",
}


@pytest.mark.skipif(not AWKWARD.is_dir(), reason="needs the folder awkward of DEHYST_DATA")
@pytest.mark.parametrize("name", EXPORTS)
def test_awkward_exports(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(AWKWARD)
    path = Path(name)
    parser = argparse.ArgumentParser()
    add_mapping_arguments(parser)
    if EXPORTS[name]:
        with pytest.raises(MissingError):
            read(path)
    recording = read(path, mapping_from(parser.parse_args(shlex.split(EXPORTS[name]))))
    assert recording.dt_s == pytest.approx(DT_S)
    assert 90.0 < np.ptp(recording.u_V) < 96.0
    factor = 80.4 / 2010.0 if "mrad" in name else 1.0
    assert 75.0 < factor * np.ptp(recording.y_um) < 83.0
