"""Periodic recordings from files: arrays of four dimensions, several columns, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dehyst.adaptive.errors import InputError
from dehyst.sim.modal.reading import read_periodic
from dehyst.sim.recordings import ColumnMap


def test_an_array_of_realisations_and_periods(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    u = np.repeat(rng.normal(size=(64, 2, 3, 1)), 4, axis=3)
    y = rng.normal(size=(64, 2, 3, 4))
    np.savez(tmp_path / "r.npz", drive=u, y_nm=1e3 * y, fs_hz=1000.0)
    mapping = ColumnMap(columns={"u": "drive", "y": "y_nm", "rate": "fs_hz"}, units={"u": "mV", "rate": "Hz"})
    record = read_periodic(tmp_path / "r.npz", mapping, skip=1)
    assert record.dt_s == 1e-3
    assert np.allclose(record.u_V, 1e-3 * u[..., 1:])
    assert np.allclose(record.y_um, y[..., 1:])
    with pytest.raises(InputError, match="skip periods: got 4 of 4"):
        read_periodic(tmp_path / "r.npz", mapping, skip=4)
    with pytest.raises(InputError, match="period: got 32, expected 64"):
        read_periodic(tmp_path / "r.npz", mapping, period=32)


def test_several_columns_are_cut_into_periods(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    period = rng.normal(size=(32, 2))
    u = np.tile(period, (3, 1))[:90]
    y = rng.normal(size=(90, 2))
    rows = np.column_stack([np.arange(90) * 1e-3, u, y])
    text = "t_s,CH1,CH2,y_um,second\n" + "\n".join(",".join(f"{v:.12g}" for v in row) for row in rows)
    (tmp_path / "r.csv").write_text(text)
    mapping = ColumnMap(columns={"u": "CH1, CH2", "y2": "second"}, units={"u": "V", "y2": "um"})
    record = read_periodic(tmp_path / "r.csv", mapping, period=32)
    # 90 samples hold two whole periods of 32.
    assert record.u_V.shape == (32, 2, 1, 2)
    assert np.allclose(record.u_V[:, :, 0, 1], u[32:64])
    assert np.allclose(record.y_um[:, :, 0, 0], y[:32])
    with pytest.raises(InputError, match="add --period N"):
        read_periodic(tmp_path / "r.csv", mapping)
    with pytest.raises(InputError, match="one whole period or more"):
        read_periodic(tmp_path / "r.csv", mapping, period=32, skip=2)
    with pytest.raises(InputError, match="no column 'CH9' for u"):
        read_periodic(tmp_path / "r.csv", ColumnMap(columns={"u": "CH1,CH9"}, units={"u": "V"}), period=32)


def test_drives_without_a_unit_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "r.npz", u=np.ones((32, 1, 1, 2)), y_um=np.ones((32, 1, 1, 2)), rate_Hz=10.0)
    with pytest.raises(InputError, match="no unit in its name"):
        read_periodic(tmp_path / "r.npz")
