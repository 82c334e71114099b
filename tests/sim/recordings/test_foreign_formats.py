"""Recordings of other programs: no header, numpy, two files, periods, MATLAB 7.3, HDF5, TDMS, Excel."""

from __future__ import annotations

import datetime
import logging
import sys
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import openpyxl
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from nptdms import ChannelObject, TdmsWriter
from numpy.typing import NDArray
from pyarrow import parquet
from scipy.io import savemat

from dehyst.adaptive.errors import InputError
from dehyst.sim.recordings import ColumnMap, Recording, array_formats, check, load_map, read
from dehyst.sim.recordings.columns import MissingError

N, DT_S = 240, 0.002
T = np.arange(N) * DT_S
U = np.round(4.0 - 4.0 * np.cos(2 * np.pi * 2.0 * T), 6)
Y = np.round(10.0 * U - 3.0 + 0.4 * np.sin(2 * np.pi * 2.0 * T), 6)
TABLE = np.column_stack([T, U, Y])
BY_POSITION = ColumnMap(columns={"t": "1", "u": "2", "y": "3"}, units={"t": "s", "u": "V", "y": "um"})
UNITS = {"u": "V", "y": "um"}


def same(recording: Recording, *, rtol: float = 0.0) -> None:
    np.testing.assert_allclose(recording.t_s, T, rtol=rtol, atol=1e-12)
    np.testing.assert_allclose(recording.u_V, U, rtol=rtol, atol=0.0)
    np.testing.assert_allclose(recording.y_um, Y, rtol=rtol, atol=0.0)
    assert recording.dt_s == DT_S


def write_text(path: Path, *top: str, table: NDArray[np.float64] = TABLE, delimiter: str = ",") -> Path:
    rows = [delimiter.join(repr(float(value)) for value in row) for row in table]
    path.write_text("\n".join([*top, *rows]) + "\n")
    return path


def write_npy(path: Path, array: NDArray[Any]) -> Path:
    np.save(path, array)
    return path


def write_v73(path: Path, **variables: Any) -> Path:
    """A file as MATLAB's ``save -v7.3`` writes it: HDF5 behind a text header, dimensions in reverse, classes noted."""

    def put(group: h5py.Group, name: str, value: Any) -> None:
        if isinstance(value, dict):
            inner = group.create_group(name)
            inner.attrs["MATLAB_class"] = np.bytes_("struct")
            for key, entry in value.items():
                put(inner, key, entry)
        elif isinstance(value, str):
            text = group.create_dataset(name, data=np.array([[ord(letter)] for letter in value], dtype=np.uint16))
            text.attrs["MATLAB_class"] = np.bytes_("char")
        else:
            array = np.atleast_2d(np.asarray(value))
            kind = {"f8": "double", "f4": "single", "i2": "int16", "b1": "logical"}[array.dtype.str[1:]]
            stored = group.create_dataset(name, data=array.T.astype(np.uint8) if kind == "logical" else array.T)
            stored.attrs["MATLAB_class"] = np.bytes_(kind)

    with h5py.File(path, "w", userblock_size=512) as file:
        for key, variable in variables.items():
            put(file, key, variable)
        cells = file.create_dataset("names", (1, 2), dtype=h5py.ref_dtype)
        cells.attrs["MATLAB_class"] = np.bytes_("cell")
        file.create_group("#refs#")["a"] = np.zeros(3)
    with path.open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64, HDF5 schema 1.00 .".ljust(116) + bytes(8) + b"\x00\x02IM")
    return path


def write_tdms(path: Path, group: str = "rig", **channels: tuple[NDArray[Any], dict[str, Any]]) -> Path:
    with TdmsWriter(path) as writer:
        writer.write_segment([ChannelObject(group, name, *content) for name, content in channels.items()])
    return path


def waveform(
    unit: str = "", dt_s: float = DT_S, start: str = "2024-05-01T10:00:00", offset_s: float = 0.0
) -> dict[str, Any]:
    return {
        "wf_increment": dt_s,
        "wf_start_time": np.datetime64(start, "us"),
        "wf_start_offset": offset_s,
        "unit_string": unit,
    }


def write_xlsx(path: Path, **sheets: list[list[Any]]) -> Path:
    book = openpyxl.Workbook()
    book.remove(book.active)
    for title, rows in sheets.items():
        sheet = book.create_sheet(title)
        for row in rows:
            sheet.append(row)
    book.save(path)
    return path


# Text without a header.


def test_names_in_the_comment_above_as_numpy_writes_them(tmp_path: Path) -> None:
    np.savetxt(tmp_path / "a.txt", TABLE, header="t_s u_V y_um", fmt="%.17g")
    recording = read(tmp_path / "a.txt")
    same(recording)
    assert "columns named by the comment above the samples: t_s, u_V, y_um" in recording.notes
    # A remark has another number of words; then there are no names.
    np.savetxt(tmp_path / "b.txt", TABLE, header="rig 7", fmt="%.17g")
    same(read(tmp_path / "b.txt", BY_POSITION))


def test_a_position_stands_for_a_name_and_keeps_its_unit(tmp_path: Path) -> None:
    table = np.column_stack([T, U * 1e3, Y])
    path = write_text(tmp_path / "a.csv", "time_s,drive_mV,sensor", table=table)
    same(read(path, ColumnMap(columns={"t": "1", "u": "2", "y": "3"}, units={"y": "um"})), rtol=1e-15)
    for position in ("4", "2:4", "3:2", "0"):
        with pytest.raises(InputError, match=r"column '.*' for y|no column '0' for y"):
            read(path, ColumnMap(columns={"t": "1", "u": "2", "y": position}, units={"y": "um"}))


def test_a_line_of_units_below_the_names(tmp_path: Path) -> None:
    path = write_text(tmp_path / "a.csv", "time,drive,sensor", "s,[V],Micrometers")
    recording = read(path, ColumnMap(columns={"t": "time", "u": "drive", "y": "sensor"}))
    same(recording)
    assert "units from line 2: time in s, drive in V, sensor in Micrometers" in recording.notes
    with pytest.raises(InputError, match=r"states the unit 'Micrometers', expected one of V"):
        read(path, ColumnMap(columns={"t": "time", "u": "sensor", "y": "drive"}))


@pytest.mark.parametrize(
    ("first", "message"),
    [
        ("0,1,2", "got 0, 1, 2 in line 1, which may be names"),
        ("1,2,3", "got 1, 2, 3 in line 1, which may be names"),
        ("2024-05-01 10:00,0.5,1.5", "got 2024-05-01 10:00, 0.5, 1.5 in line 1, which may be names"),
    ],
)
def test_a_first_line_that_may_be_names_or_a_sample_needs_the_option(tmp_path: Path, first: str, message: str) -> None:
    path = write_text(tmp_path / "a.csv", first)
    with pytest.raises(InputError, match=rf"{message}.*--header 1 .*--header none"):
        read(path, BY_POSITION)
    # A name goes over a position.
    columns = {"t": "0", "u": "1", "y": "2"} if first[0] == "0" else BY_POSITION.columns
    same(read(path, ColumnMap(columns=columns, units=BY_POSITION.units, header="1")))
    if first[0] in "01":
        whole = ColumnMap(columns=BY_POSITION.columns, units=BY_POSITION.units, header="none")
        assert len(read(path, whole)) == N + 1


# numpy.


def test_npy_with_fields_and_with_an_index(tmp_path: Path) -> None:
    fields = np.array(list(map(tuple, TABLE)), dtype=[("t_s", "f8"), ("u_V", "f8"), ("y_um", "f8")])
    same(read(write_npy(tmp_path / "fields.npy", fields)))
    columns = write_npy(tmp_path / "table.npy", TABLE)
    mapping = ColumnMap(index={"t": ":,0", "u": ":,1", "y": ":,2"}, units=BY_POSITION.units)
    same(read(columns, mapping))
    with pytest.raises(InputError, match=r"(?s)table\[240, 3\],.*which column is u_V"):
        read(columns, ColumnMap(units=UNITS, dt_s=DT_S))
    with pytest.raises(InputError, match=r"shape \(240, 3\).*--index u=:,0 .*--index u=\*,:"):
        read(columns, ColumnMap(columns={"u": "table"}, units=UNITS, dt_s=DT_S))


def test_pickles_are_never_loaded(tmp_path: Path) -> None:
    class Trap:
        def __reduce__(self) -> tuple[Callable[[str], Any], tuple[str]]:
            return Path.touch.__get__(tmp_path / "opened"), ()  # type: ignore[return-value]

    objects = np.array([Trap()] * N, dtype=object)
    np.save(tmp_path / "a.npy", objects, allow_pickle=True)
    np.savez(tmp_path / "a.npz", u_V=objects)
    for name in ("a.npy", "a.npz"):
        with pytest.raises(InputError, match="holds a pickled Python object, which is never loaded"):
            read(tmp_path / name)
    assert not (tmp_path / "opened").exists()


# Two files.


def test_voltage_and_sensor_in_two_files(tmp_path: Path) -> None:
    main = write_npy(tmp_path / "u_V.npy", U)
    other = write_npy(tmp_path / "y_um.npy", Y)
    recording = read(main, ColumnMap(files={"y": other}, dt_s=DT_S))
    same(recording)
    assert recording.sha256 != read(main, ColumnMap(files={"y": main}, scale={"y": 1.0}, dt_s=DT_S)).sha256


def test_files_whose_only_column_needs_no_name(tmp_path: Path) -> None:
    main = write_text(tmp_path / "drive.csv", table=U.reshape(-1, 1))
    other = write_text(tmp_path / "sensor.csv", table=Y.reshape(-1, 1))
    clock = write_text(tmp_path / "clock.csv", table=T.reshape(-1, 1))
    units = {"t": "s", **UNITS}
    same(read(main, ColumnMap(files={"y": other, "t": clock}, units=units)))
    same(read(main, ColumnMap(files={"y": other}, units=UNITS, dt_s=DT_S)))
    with pytest.raises(InputError, match=r"(?s)drive\.csv: got columns 1.*1\. the unit of column '1' for u") as caught:
        read(main, ColumnMap(files={"y": other}, dt_s=DT_S))
    assert isinstance(caught.value, MissingError)
    assert caught.value.options == ("--unit u=UNIT", "--unit y=UNIT")
    # Alone, the file may hold anything.
    with pytest.raises(InputError, match=r"(?s)which column is u_V.*--column u=NAME .*position.*--file u=FILE"):
        read(main, ColumnMap(units=UNITS, dt_s=DT_S))


def test_two_files_with_a_time_each_must_agree(tmp_path: Path) -> None:
    main = write_text(tmp_path / "a.csv", "t_s,u_V", table=np.column_stack([T, U]))
    other = write_text(tmp_path / "b.csv", table=np.column_stack([T, Y]))
    mapping = ColumnMap(files={"y": other}, columns={"y": "2"}, units={"y": "um"})
    same(read(main, mapping))
    late = write_text(tmp_path / "c.csv", "t_s,y_um", table=np.column_stack([T + 0.5 * DT_S, Y]))
    with pytest.raises(InputError, match=r"c\.csv: got the time 0\.\d+ s for sample \d+, expected .*--file t=FILE"):
        read(main, ColumnMap(files={"y": late}))
    same(read(main, ColumnMap(files={"y": late, "t": main})))
    fast = write_text(tmp_path / "d.csv", "t_s,y_um", table=np.column_stack([T, Y])[:-5])
    with pytest.raises(InputError, match=r"got 240 samples of u_V and 235 of y_um.*resample"):
        read(main, ColumnMap(files={"y": fast}))


def test_a_missing_second_file_and_a_missing_column_in_it(tmp_path: Path) -> None:
    main = write_npy(tmp_path / "u_V.npy", U)
    with pytest.raises(InputError, match=r"none\.csv: cannot be read"):
        read(main, ColumnMap(files={"y": tmp_path / "none.csv"}, dt_s=DT_S))
    other = write_text(tmp_path / "b.csv", "time,sensor,probe")
    with pytest.raises(InputError, match=r"b\.csv: got columns time, sensor, probe, expected y_um"):
        read(main, ColumnMap(files={"y": other}, dt_s=DT_S))


# Periods.


def test_periods_in_an_array_are_put_one_after_another(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", u_V=U.reshape(4, 60), y_um=Y.reshape(4, 60).T)
    recording = read(tmp_path / "a.npz", ColumnMap(index={"u": "*,:", "y": ":,*"}, dt_s=DT_S))
    same(recording)
    assert "u: 4 periods of 60 samples put one after another" in recording.notes
    assert any("4 periods of 60" in finding.message for finding in check(recording))
    with pytest.raises(InputError, match=r"shape \(4, 60\), expected one value per sample.*--index u=\*,:"):
        read(tmp_path / "a.npz", ColumnMap(dt_s=DT_S))
    for bad in ("*,*", "*,0", ":,:", "*,:,:", "**,:"):
        with pytest.raises(InputError, match=r"index of u: got .*'\*' for periods"):
            read(tmp_path / "a.npz", ColumnMap(index={"u": bad, "y": ":,*"}, dt_s=DT_S))


def test_one_period_of_the_drive_beside_many_of_readings(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", t_s=T[:60], u_V=U[:60], y_um=Y[:200])
    with pytest.raises(InputError, match=r"t_s: got 60 samples, expected 200 .*--rate HZ"):
        read(tmp_path / "a.npz", ColumnMap(repeat=("u",)))
    recording = read(tmp_path / "a.npz", ColumnMap(repeat=("u",), dt_s=DT_S))
    np.testing.assert_array_equal(recording.u_V, np.concatenate([U[:60]] * 4)[:200])
    np.testing.assert_array_equal(recording.y_um, Y[:200])
    np.testing.assert_allclose(recording.t_s, np.arange(200) * DT_S, atol=1e-12)
    assert recording.dt_s == DT_S
    assert any("u: its 60 samples are one period and are repeated 3.333 times" in note for note in recording.notes)


def test_contradictory_lengths_are_never_repeated_by_themselves(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", u_V=U[:60], y_um=Y, short=T[:59])
    with pytest.raises(InputError, match=r"60 samples of u_V and 240 of y_um.*--repeat u .*1/4 of the other"):
        read(tmp_path / "a.npz", ColumnMap(dt_s=DT_S))
    with pytest.raises(InputError, match=r"repeat temperature: got no such column"):
        read(tmp_path / "a.npz", ColumnMap(dt_s=DT_S, repeat=("u", "temperature")))
    with pytest.raises(InputError, match=r"t_s: got 59 samples, expected 240"):
        read(tmp_path / "a.npz", ColumnMap(columns={"t": "short"}, units={"t": "s"}, repeat=("u",)))
    with pytest.raises(InputError, match=r"60 samples of u_V and 240 of y_um"):
        read(tmp_path / "a.npz", ColumnMap(dt_s=DT_S, repeat=("y",)))
    for quantity in ("t", "dt", "z"):
        with pytest.raises(InputError, match="repeat: got"):
            ColumnMap(repeat=(quantity,))


@settings(max_examples=40, deadline=None)
@given(
    periods=st.integers(2, 6),
    length=st.integers(2, 40),
    outer=st.integers(1, 3),
    axes=st.permutations([0, 1, 2]),
    seed=st.integers(0, 2**32 - 1),
)
def test_any_order_of_dimensions_gives_the_same_samples(
    periods: int, length: int, outer: int, axes: list[int], seed: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    rng = np.random.default_rng(seed)
    y = rng.normal(size=(outer, periods, length))
    chosen = int(rng.integers(outer))
    entries = np.array([str(chosen), "*", ":"])[axes]
    path = tmp_path_factory.mktemp("axes") / "a.npz"
    u = rng.normal(size=length)
    np.savez(path, u_V=u, y_um=y.transpose(axes))
    recording = read(path, ColumnMap(index={"y": ",".join(entries)}, repeat=("u",), dt_s=DT_S))
    np.testing.assert_array_equal(recording.y_um, y[chosen].reshape(-1))
    np.testing.assert_array_equal(recording.u_V, np.tile(u, periods))


# MATLAB 7.3 and HDF5.


def test_matlab_7_3_reads_as_the_older_versions_do(tmp_path: Path) -> None:
    variables = {"t_s": T.reshape(-1, 1), "rec": {"u": U, "y": np.stack([Y, 0 * Y], axis=1) * 1e3}, "name": "rig"}
    mapping = ColumnMap(columns={"u": "rec.u", "y": "rec.y"}, units={"u": "V", "y": "nm"}, index={"y": ":,0"})
    savemat(tmp_path / "v5.mat", variables)
    same(read(tmp_path / "v5.mat", mapping), rtol=1e-15)
    write_v73(tmp_path / "v73.mat", **variables)
    same(read(tmp_path / "v73.mat", mapping), rtol=1e-15)
    for version in ("v5", "v73"):
        with pytest.raises(InputError, match=r"rec\.u, rec\.y\[240, 2\].*\(left out: .*name \(text\)") as caught:
            read(tmp_path / f"{version}.mat")
    assert "names (cells)" in str(caught.value)


def test_hdf5_with_groups_and_stated_units(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        run = file.create_group("run1")
        run.create_dataset("drive", data=U * 1e3, compression="gzip").attrs["units"] = "mV"
        run["sensor"] = Y
        run["sensor"].attrs["unit"] = "micron"
        file["t_s"] = T
        file["elsewhere"] = h5py.ExternalLink("other.h5", "/u")
        file["table"] = np.zeros(3, dtype=[("a", "f8"), ("b", "f8")])
    columns = {"u": "run1.drive", "y": "run1.sensor"}
    same(read(tmp_path / "a.h5", ColumnMap(columns=columns)), rtol=1e-15)
    with pytest.raises(InputError, match=r"table\.a, table\.b \(left out: elsewhere \(a link\)\)"):
        read(tmp_path / "a.h5")


def test_hdf5_does_not_open_other_files(tmp_path: Path) -> None:
    (tmp_path / "secret.bin").write_bytes(U.tobytes())
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("u_V", shape=(N,), dtype="f8", external=[(str(tmp_path / "secret.bin"), 0, U.nbytes)])
        file["y_um"] = Y
    with pytest.raises(InputError, match=r"left out: u_V \(its values are in another file\)"):
        read(tmp_path / "a.h5", ColumnMap(dt_s=DT_S))


def test_hdf5_that_unpacks_to_more_than_the_memory_is_refused(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("u_V", shape=(10**9,), dtype="f8", chunks=(10**6,), compression="gzip")
    assert (tmp_path / "a.h5").stat().st_size < 100_000
    with pytest.raises(InputError, match=r"more than 2 GB unpacked \(u_V has shape"):
        read(tmp_path / "a.h5", ColumnMap(dt_s=DT_S))


def test_hdf5_with_a_loop_of_groups_is_refused(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        group = file.create_group("a")
        group["a"] = group
    with pytest.raises(InputError, match="16 levels of groups"):
        read(tmp_path / "a.h5")


# TDMS.


def test_tdms_with_units_and_sample_time(tmp_path: Path) -> None:
    path = write_tdms(
        tmp_path / "a.tdms", u=(U * 1e3, waveform("mV")), sensor=(Y.astype(np.float64), waveform("Micrometers"))
    )
    recording = read(path, ColumnMap(columns={"y": "sensor"}))
    same(recording, rtol=1e-15)
    assert "sample time 0.002 s as the file states it" in recording.notes


def test_tdms_channels_of_several_groups_segments_and_times_of_day(tmp_path: Path) -> None:
    stamps = np.datetime64("2024-05-01T10:00:00", "us") + np.round(T * 1e6).astype("timedelta64[us]")
    with TdmsWriter(tmp_path / "a.tdms") as writer:
        for part in (slice(0, 100), slice(100, N)):
            channels = [
                ChannelObject("A", "value", U[part]),
                ChannelObject("B", "value", Y[part]),
                ChannelObject("A", "when", stamps[part]),
                ChannelObject("A", "remark", ["ok"] * len(U[part])),
            ]
            writer.write_segment(channels)
    mapping = ColumnMap(columns={"t": "when", "u": "A/value", "y": "B/value"}, units=UNITS)
    same(read(tmp_path / "a.tdms", mapping), rtol=1e-12)
    with pytest.raises(InputError, match=r"(?s)A/value, when, B/value \(left out: remark \(no numbers\)\),.*u_V"):
        read(tmp_path / "a.tdms")


@pytest.mark.parametrize(
    ("properties", "message"),
    [
        (waveform("V"), r"'sensor' for y: the file states the unit 'V', expected one of um.*--unit y=um.*--scale"),
        (waveform("um", dt_s=0.001), r"sensor of .*sample time of 0\.001 s, expected 0\.002 s as u of .*--dt-s"),
        (waveform("um", start="2024-05-01T10:00:01"), r"sensor of .*starts \+1 s after u of .*--dt-s"),
        (waveform("um", offset_s=-0.001), r"starts -0\.001 s after"),
    ],
)
def test_tdms_channels_that_contradict_each_other(tmp_path: Path, properties: dict[str, Any], message: str) -> None:
    path = write_tdms(tmp_path / "a.tdms", u=(U, waveform("V")), sensor=(Y, properties))
    with pytest.raises(InputError, match=message):
        read(path, ColumnMap(columns={"y": "sensor"}))
    same(read(path, ColumnMap(columns={"y": "sensor"}, units={"y": "um"}, dt_s=DT_S)))


def test_a_name_and_a_stated_unit_that_differ_are_refused(tmp_path: Path) -> None:
    path = write_tdms(tmp_path / "a.tdms", u_V=(U, waveform("Volts")), y_nm=(Y * 1e3, waveform("um")))
    with pytest.raises(InputError, match=r"states the unit 'um' and its name says nm.*--unit y=um or y=nm"):
        read(path)
    same(read(path, ColumnMap(units={"y": "nm"})), rtol=1e-15)


# Excel.


def test_xlsx_with_and_without_names(tmp_path: Path) -> None:
    rows = TABLE.tolist()
    same(read(write_xlsx(tmp_path / "a.xlsx", Data=[["t_s", "u_V", "y_um"], *rows], Empty=[])))
    same(read(write_xlsx(tmp_path / "b.xlsx", Data=rows), BY_POSITION))
    named = ColumnMap(columns={"t": "time", "u": "drive", "y": "sensor"})
    path = write_xlsx(tmp_path / "c.xlsx", Data=[["rig 7"], ["time", "drive", "sensor"], ["s", "V", "um"], *rows])
    same(read(path, ColumnMap(columns=named.columns, header="2")))
    with pytest.raises(InputError, match="header: got line 999"):
        read(path, ColumnMap(header="999"))
    numbered = write_xlsx(tmp_path / "d.xlsx", Data=[[0, 1, 2], *rows])
    with pytest.raises(InputError, match=r"got 0, 1, 2 in line 1, .*--header none"):
        read(numbered, BY_POSITION)


def test_xlsx_of_two_sheets_times_of_day_and_gaps(tmp_path: Path) -> None:
    start = datetime.datetime(2024, 5, 1, 10, 0, 0)
    drive = [[start + datetime.timedelta(seconds=float(t)), float(u)] for t, u in zip(T, U, strict=True)]
    sensor: list[list[Any]] = [[float(y)] for y in Y]
    sensor[7] = [None]
    path = write_xlsx(tmp_path / "a.xlsx", Drive=[["when", "u_V"], *drive], Sensor=[["y_um"], *sensor])
    mapping = ColumnMap(columns={"t": "Drive!when", "u": "Drive!u_V", "y": "Sensor!y_um"})
    recording = read(path, mapping)
    np.testing.assert_allclose(recording.t_s, T, atol=1e-6)
    np.testing.assert_array_equal(recording.u_V, U)
    assert np.isnan(recording.y_um[7])
    np.testing.assert_array_equal(np.delete(recording.y_um, 7), np.delete(Y, 7))
    with pytest.raises(InputError, match=r"(?s)got columns Drive!when, Drive!u_V, Sensor!y_um,.*u_V"):
        read(path)


def test_xlsx_that_holds_no_recording(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="workbook without values"):
        read(write_xlsx(tmp_path / "a.xlsx", Data=[]))
    with pytest.raises(InputError, match="a header line and no samples"):
        read(write_xlsx(tmp_path / "b.xlsx", Data=[["t_s", "u_V", "y_um"]]))
    with pytest.raises(InputError, match="got 'off' in data row 2, expected a number"):
        read(write_xlsx(tmp_path / "c.xlsx", Data=[["t_s", "u_V", "y_um"], [0.0, 1.0, 2.0], [1.0, "off", 3.0]]))
    (tmp_path / "d.xls").write_bytes(b"\xd0\xcf\x11\xe0")
    with pytest.raises(InputError, match=r"old Excel workbook, expected \.xlsx"):
        read(tmp_path / "d.xls")


# All of them.


def whole_files(folder: Path) -> list[Path]:
    np.savez(folder / "a.npz", t_s=T, u_V=U, y_um=Y)
    savemat(folder / "a.mat", {"t_s": T, "u_V": U, "y_um": Y})
    parquet.write_table(pa.table({"t_s": T, "u_V": U, "y_um": Y}), folder / "a.parquet")
    with h5py.File(folder / "a.h5", "w") as file:
        file["t_s"], file["u_V"], file["y_um"] = T, U, Y
    fields = np.array(list(map(tuple, TABLE)), dtype=[("t_s", "f8"), ("u_V", "f8"), ("y_um", "f8")])
    return [
        folder / "a.npz",
        folder / "a.mat",
        folder / "a.parquet",
        folder / "a.h5",
        write_npy(folder / "a.npy", fields),
        write_v73(folder / "b.mat", t_s=T, u_V=U, y_um=Y),
        write_tdms(folder / "a.tdms", u_V=(U, waveform()), y_um=(Y, waveform())),
        write_xlsx(folder / "a.xlsx", Data=[["t_s", "u_V", "y_um"], *TABLE.tolist()]),
        write_text(folder / "a.csv", "t_s,u_V,y_um"),
    ]


@pytest.fixture(scope="module")
def contents(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Name -> bytes of a whole file of each format."""
    return {path.name: path.read_bytes() for path in whole_files(tmp_path_factory.mktemp("whole"))}


NAMES = ("a.npz", "a.mat", "b.mat", "a.parquet", "a.h5", "a.npy", "a.tdms", "a.xlsx")


@pytest.mark.parametrize("name", NAMES)
def test_whole_and_cut_files(contents: dict[str, bytes], name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(contents[name])
    same(read(path))
    rng = np.random.default_rng(5)
    cuts = 2 if name == "a.mat" else 12  # each file of this format starts a process
    for length in sorted({1, 7, *rng.integers(8, len(contents[name]), cuts).tolist(), len(contents[name]) - 1}):
        path.write_bytes(contents[name][:length])
        with pytest.raises(InputError, match=name):
            read(path)


@pytest.mark.parametrize("name", [name for name in NAMES if name[2:] not in ("npz", "xlsx")])
def test_a_file_with_another_ending_is_known_by_its_first_bytes(
    contents: dict[str, bytes], name: str, tmp_path: Path
) -> None:
    path = tmp_path / "a.dat"
    path.write_bytes(contents[name])
    same(read(path))
    path.write_bytes(b"MATLAB u_V,y_um\n1,2\n3,4\n")
    assert len(read(path, ColumnMap(columns={"u": "1"}, units={"u": "V"}, dt_s=DT_S))) == 2


def gives_samples_or_an_input_error(data: st.DataObject, content: bytes, path: Path) -> None:
    damaged = bytearray(content)
    for _ in range(data.draw(st.integers(1, 6))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(damaged)
    try:
        recording = read(path)
    except InputError:
        return
    assert len(recording.u_V) == len(recording.y_um) == len(recording.t_s)


@settings(max_examples=80, deadline=None, derandomize=True)
@given(data=st.data(), name=st.sampled_from([*(name for name in NAMES if name != "a.mat"), "a.csv"]))
def test_a_damaged_file_gives_samples_or_an_input_error(
    data: st.DataObject, name: str, contents: dict[str, bytes], tmp_path_factory: pytest.TempPathFactory
) -> None:
    gives_samples_or_an_input_error(data, contents[name], tmp_path_factory.mktemp("damaged") / name)


@settings(max_examples=5, deadline=None, derandomize=True)
@given(data=st.data(), compressed=st.booleans())
def test_a_damaged_matlab_file_gives_samples_or_an_input_error(
    data: st.DataObject, compressed: bool, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp("damaged") / "a.mat"
    savemat(path, {"t_s": T[:20], "u_V": U[:20], "y_um": Y[:20]}, do_compression=compressed)
    gives_samples_or_an_input_error(data, path.read_bytes(), path)


@pytest.mark.parametrize("compressed", [False, True])
def test_a_matlab_file_that_ends_its_reader_is_refused(tmp_path: Path, compressed: bool) -> None:
    """scipy 1.17 takes an invalid type of data as an index: a segmentation fault."""
    path = tmp_path / "a.mat"
    savemat(path, {"t_s": T, "u_V": U, "y_um": Y})
    content = bytearray(path.read_bytes())
    doubles = content.index((9).to_bytes(4, "little") + (8 * N).to_bytes(4, "little"))
    content[doubles : doubles + 4] = (0x1109).to_bytes(4, "little")
    if compressed:
        packed = zlib.compress(bytes(content[128:]))
        content[128:] = (15).to_bytes(4, "little") + len(packed).to_bytes(4, "little") + packed
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"a\.mat: is not a whole \.mat file \(.*save it again"):
        read(path)


def test_a_matlab_file_that_takes_too_long_or_too_much_memory_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.mat"
    savemat(path, {"t_s": T, "u_V": U, "y_um": np.zeros(2_000_000)}, do_compression=True)
    monkeypatch.setattr(array_formats, "MATLAB_MEMORY_BYTES", 10_000_000)
    with pytest.raises(InputError, match=r"a\.mat: is not a whole \.mat file \("):
        read(path)
    monkeypatch.setattr(array_formats, "MATLAB_TIME_S", 0.001)
    with pytest.raises(InputError, match=r"a\.mat: is not a whole \.mat file \(not read within"):
        read(path)


@pytest.mark.parametrize(
    ("name", "package"), [("a.h5", "h5py"), ("b.mat", "h5py"), ("a.tdms", "npTDMS"), ("a.xlsx", "openpyxl")]
)
def test_a_missing_package_is_named_with_the_command_that_installs_it(
    contents: dict[str, bytes], name: str, package: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / name).write_bytes(contents[name])
    for module in ("h5py", "nptdms", "openpyxl"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(InputError, match=rf"{name}: .*package {package}, .*python -m pip install {package}"):
        read(tmp_path / name)


def test_map_file_with_files_positions_and_periods(tmp_path: Path) -> None:
    folder = tmp_path / "rig"
    folder.mkdir()
    write_npy(folder / "drive.npy", U[:60])
    write_text(folder / "sensor.csv", table=np.column_stack([T, Y]))
    (folder / "map.toml").write_text(
        'repeat = ["u"]\nheader = "none"\n[columns]\nt = 1\ny = 2\n[files]\nu = "drive.npy"\n'
        '[units]\nt = "s"\nu = "V"\ny = "um"\n'
    )
    recording = read(folder / "sensor.csv", load_map(folder / "map.toml"))
    np.testing.assert_array_equal(recording.u_V, np.tile(U[:60], 4))
    np.testing.assert_array_equal(recording.y_um, Y)
    for text, message in (
        ("repeat = 'u'", "repeat: got 'u', expected list"),
        ("repeat = [1]", "repeat: got 1, expected str"),
        ("[files]\ny = 1", "files.y: got 1, expected str"),
        ("header = true", "header: got True, expected str"),
        ("header = 0", "header: got '0'"),
        ("[columns]\ny = 1.5", "columns.y: got 1.5, expected str"),
    ):
        (folder / "map.toml").write_text(text)
        with pytest.raises(InputError, match=message):
            load_map(folder / "map.toml")


def test_nothing_is_logged_or_printed_by_the_packages(
    contents: dict[str, bytes], tmp_path: Path, capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG)
    for name in ("a.tdms", "a.h5", "a.xlsx"):
        (tmp_path / name).write_bytes(contents[name][:-50])
        with pytest.raises(InputError):
            read(tmp_path / name)
    captured = capfd.readouterr()
    assert (captured.out, captured.err) == ("", "")
    assert not [record for record in caplog.records if record.name.startswith("nptdms")]
