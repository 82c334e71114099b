"""Readers: every format gives the same recording; every bad file gets a message that mends it."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyarrow import parquet

from dehyst.adaptive.errors import InputError
from dehyst.sim.recordings import ColumnMap, Recording, load_map, read

N = 300
T = np.arange(N) * 0.002
U = np.round(4.0 - 4.0 * np.cos(2 * np.pi * 2.0 * T), 6)
Y = np.round(10.0 * U - 3.0 + 0.4 * np.sin(2 * np.pi * 2.0 * T), 6)


def write_csv(path: Path, header: str, *columns: np.ndarray, delimiter: str = ",") -> Path:
    rows = [delimiter.join(f"{value:.9g}" for value in row) for row in zip(*columns, strict=True)]
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


def same(recording: Recording) -> None:
    np.testing.assert_allclose(recording.t_s, T, atol=1e-9)
    np.testing.assert_allclose(recording.u_V, U, atol=1e-6)
    np.testing.assert_allclose(recording.y_um, Y, atol=1e-6)
    assert recording.dt_s == 0.002


def test_canonical_csv(tmp_path: Path) -> None:
    recording = read(write_csv(tmp_path / "a.csv", "t_s,u_V,y_um,temperature_C", T, U, Y, 20 + T))
    same(recording)
    assert recording.temperature_C is not None
    assert recording.u2_V is None
    assert len(recording.sha256) == 64


def test_scale_in_place_of_a_unit_and_kelvin(tmp_path: Path) -> None:
    path = write_csv(tmp_path / "a.csv", "t_s,u_V,sensor_V,temperature_K", T, U, Y / 10.0, np.full(N, 293.15))
    recording = read(path, ColumnMap(columns={"y": "sensor_V"}, scale={"y": 10.0}))
    same(recording)
    assert recording.temperature_C is not None
    np.testing.assert_allclose(recording.temperature_C, 20.0)


def test_parquet_with_timestamps(tmp_path: Path) -> None:
    stamps = pa.array((np.round(T * 1e9)).astype("datetime64[ns]"))
    parquet.write_table(pa.table({"t_s": stamps, "u_V": U, "y_um": Y}), tmp_path / "a.parquet")
    same(read(tmp_path / "a.parquet"))


def test_a_folder_of_segments_is_one_recording(tmp_path: Path) -> None:
    for k, part in enumerate((slice(0, 100), slice(100, N))):
        table = pa.table({"t_s": T[part], "u_V": U[part], "y_um": Y[part], "reason": ["learnt"] * len(T[part])})
        parquet.write_table(table, tmp_path / f"segment-{k:03d}.parquet")
    recording = read(tmp_path)
    same(recording)
    assert recording.reason is not None
    assert recording.notes == ("2 segments",)


def test_mat_7_3_without_its_data_is_refused(tmp_path: Path) -> None:
    head = b"MATLAB 7.3 MAT-file, Platform: GLNXA64, Created on: Mon".ljust(116)
    (tmp_path / "a.mat").write_bytes(head + bytes(8) + b"\x00\x02IM" + bytes(400))
    with pytest.raises(InputError, match=r"announces MATLAB 7\.3 \(HDF5\) and holds no HDF5 data.*save it again"):
        read(tmp_path / "a.mat")


def test_npz_with_several_dimensions_and_a_rate(tmp_path: Path) -> None:
    y = np.zeros((N, 3, 2))
    y[:, 2, 1] = Y * 1e-6
    np.savez(tmp_path / "a.npz", u_N=U, y_m=y, fs_hz=500.0)
    columns = {"u": "u_N", "y": "y_m", "rate": "fs_hz"}
    same(read(tmp_path / "a.npz", ColumnMap(columns=columns, scale={"u": 1.0}, index={"y": ":,2,1"})))
    with pytest.raises(InputError, match=r"shape \(300, 3, 2\).*--index y=:,0,0"):
        read(tmp_path / "a.npz", ColumnMap(columns=columns, scale={"u": 1.0}))
    for bad in (":,3,1", ":,0", "0,0,0", ":,:,0", ":,x,0", ":,-1,0"):
        with pytest.raises(InputError, match="index of y"):
            read(tmp_path / "a.npz", ColumnMap(columns=columns, scale={"u": 1.0}, index={"y": bad}))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "empty file"),
        ("\n\n", "no data"),
        ("0,1,2\n0.1,1,2\n", "got 0, 1, 2 in line 1, which may be names.*--header 1 .*--header none"),
        ("t_s,u_V,u_V\n0,1,2\n", r"(?s)t_s, u_V \(column 2\), u_V \(column 3\),.*u_V, the voltage .--column u="),
        ("t_s,u_V,y_um\n", "no samples|not a table"),
        ("t_s,u_V,y_um\n0,1,2\n1,2\n", "not a table of 3 columns"),
        ("t_s,u_V,y_um\n0,1,2\n1,2,off\n", "'off' in data row 2"),
        ("t_s,u_V,y\n0,1,2\n1,2,3\n", r"'y' for y has no unit.*um, .*nm.*--unit y=um"),
        ("t_s,u_V,sensor\n0,1,2\n", r"t_s, u_V, sensor, expected y_um: add --column y=NAME"),
        ("t_s,u_V,y_nm,y_mm\n0,1,2,3\n", "y_nm, y_mm, expected one"),
        ("t_s,u_V,y_um\n0,1,2\n0,2,3\n", "never increases"),
    ],
)
def test_bad_text_gets_a_message(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        read(path)
    assert "bad.csv" in str(caught.value)


def test_missing_file_and_empty_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.csv: cannot be read"):
        read(tmp_path / "none.csv")
    with pytest.raises(InputError, match=r"without \.parquet files"):
        read(tmp_path)


def test_map_file(tmp_path: Path) -> None:
    (tmp_path / "map.toml").write_text(
        'sensor_late = 1\n[columns]\nt = "time"\nu = "drive"\ny = "pos"\n[units]\nt = "s"\nu = "V"\n[scale]\ny = 2\n'
    )
    mapping = load_map(tmp_path / "map.toml")
    recording = read(write_csv(tmp_path / "a.csv", "time,drive,pos", T, U, Y), mapping)
    assert len(recording) == N - 1
    np.testing.assert_allclose(recording.y_um, 2.0 * Y[1:], atol=1e-6)
    np.testing.assert_allclose(recording.u_V, U[:-1], atol=1e-6)
    np.testing.assert_allclose(recording.t_s, T[:-1], atol=1e-9)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("column = 1", "unknown key 'column'"),
        ("[columns]\nz = 'a'", "quantity 'z'"),
        ("[units]\ny = 'inch'", "unit of y: got 'inch', expected one of um"),
        ("[units]\ny = 3", "units.y: got 3, expected str"),
        ("[scale]\ny = 0.0", "scale of y"),
        ("[scale]\ny = 1.0\n[units]\ny = 'um'", "both a unit and a scale"),
        ("sensor_late = -1", "sensor_late: got -1"),
        ("dt_s = 0", "dt_s"),
        ("not toml", "is not TOML"),
    ],
)
def test_bad_maps(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "map.toml").write_text(text)
    with pytest.raises(InputError, match=message):
        load_map(tmp_path / "map.toml")


@settings(max_examples=15, deadline=None)
@given(data=st.data())
def test_any_column_order_and_unit_gives_the_same_recording(
    data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    units = {"t": {"s": 1.0, "ms": 1e-3, "us": 1e-6}, "u": {"V": 1.0, "mV": 1e-3}, "y": {"um": 1.0, "nm": 1e-3}}
    columns = {"t": T, "u": U, "y": Y}
    order = data.draw(st.permutations(sorted(columns)))
    chosen = {q: data.draw(st.sampled_from(sorted(units[q]))) for q in order}
    path = tmp_path_factory.mktemp("order") / "a.csv"
    write_csv(path, ",".join(order), *[columns[q] / units[q][chosen[q]] for q in order])
    same(read(path, ColumnMap(units=chosen)))


def test_measured_files_of_every_folder() -> None:
    data_dir = Path(os.environ.get("DEHYST_DATA", Path(__file__).resolve().parents[3].parent / "shared" / "data"))
    if not data_dir.is_dir():
        pytest.skip(f"no measured data at {data_dir} (DEHYST_DATA)")
    recording = read(data_dir / "picma_stack" / "model_sine_1hz.csv")
    assert (len(recording), recording.dt_s) == (8027, 0.005)
    mirror = ColumnMap(columns={"u": "u", "rate": "fs_hz"}, units={"u": "V"}, index={"u": ":,2,1,0", "y": ":,0,1,0"})
    recording = read(data_dir / "fine_steering_mirror" / "fsm_100mV_test.npz", mirror)
    assert (len(recording), recording.dt_s) == (8192, 1.0 / 6400)
    benchmark = ColumnMap(columns={"u": "u_N", "y": "y_m", "rate": "fs_hz"}, scale={"u": 1.0})
    recording = read(data_dir / "boucwen_benchmark" / "test_multisine.npz", benchmark)
    assert float(np.sqrt(np.mean(recording.y_um**2))) == pytest.approx(667.0, rel=0.01)
