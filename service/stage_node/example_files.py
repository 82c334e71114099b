"""The files that the examples of ``--help`` name, made by simulated stages: an empty folder is enough to try them."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
import pyarrow
from numpy.typing import ArrayLike
from pyarrow import parquet

from dehyst.adaptive.types import FloatArray
from dehyst.service.config.reference import example
from dehyst.service.protocol.errors import FieldError
from dehyst.sim.signals.voltages import generalisation_input, multitone, training_input
from dehyst.sim.stage.file import save_stage
from dehyst.sim.stage.presets import preset
from dehyst.sim.stage.stage import Stage

#: Files and folders that are written, and what they are.
FILES: Final = {
    "recording.csv": "12 s of the simulated stage, 0 to 8 V, 1 kHz",
    "scope.csv": "the same as an oscilloscope shows it: ms, CH1 the drive in V, CH2 the sensor, 10 µm/V",
    "train.csv": "another motion of 12 s",
    "test.csv": "a third one",
    "recordings": "x/ in it: a segment as the recorder of a service writes it",
    "drive.npy": "one period of a drive, 10 kHz",
    "readings.npy": "readings of 8 periods of it",
    "low.npz": "two drives and two outputs for 'dehyst modes'",
    "high.npz": "the same at a larger amplitude",
    "a.csv": "three drives and two outputs",
    "b.csv": "a second realisation of them",
    "c.csv": "a third one",
    "serve.toml": "for a service with the stage.npz that 'dehyst identify' writes",
    "learner.toml": "settings of the learner",
    "mystage.toml": "a stage file, to compare a recording with",
    "mine.py": "a plant for 'dehyst rehearse'",
    "trajectory.csv": "points for 'dehyst query'",
}
#: Sample time and length of the recordings, s.
DT_S, LENGTH_S = 1e-3, 12.0
#: Periods of the drive that readings.npy holds, samples of one, and their sample time, s.
PERIODS, PERIOD, PERIOD_DT_S = 8, 5000, 1e-4
#: Where the standby of the examples listens.
STANDBY: Final = "tcp/127.0.0.1:7449"
#: Modes of the recordings of ``dehyst modes``: frequency, Hz, damping, share of the frequency that it falls by per volt
#: rms, and static gain of outputs and drives, µm/V. Noise of a reading, µm.
MODES: Final = (
    (90.0, 0.03, 0.0, ((1.0, 0.5, 0.3), (0.2, 0.1, 0.4))),
    (230.0, 0.02, 0.05, ((0.3, -1.0, 0.2), (-0.6, 2.0, 0.5))),
)
NOISE_UM: Final = 1e-3

LEARNER_TOML: Final = """\
window = 400
[drift]
gain_walk = 0.03
"""
MINE_PY: Final = '''\
"""A plant as a function, for ``dehyst rehearse``: a first-order lag with a backlash of 4 V."""

import numpy as np

play_V = y_um = 0.0
noise = np.random.default_rng(1)


def run(u_V):
    """(true displacement, reading), both (n,) µm, under (n,) voltages."""
    global play_V, y_um
    true_um = np.empty(len(u_V))
    for k, u in enumerate(u_V):
        true_um[k] = y_um
        play_V = min(max(play_V, u - 2.0), u + 2.0)
        y_um += 0.6 * (0.5 * u + 0.1 * play_V - y_um)
    return true_um, true_um + 0.004 * noise.standard_normal(len(u_V))
'''


def write_examples(folder: Path) -> None:
    """Write all `FILES` into ``folder``, which is made.

    Raises FieldError where one of the files is there already: none is replaced; OSError from the disk.
    """
    if there := [name for name in FILES if (folder / name).exists()]:
        raise FieldError(
            "--examples", f"{folder} with {', '.join(there)} in it", "a folder without files of these names",
            "name a new folder: no file is replaced",
        )  # fmt: skip
    folder.mkdir(parents=True, exist_ok=True)
    _recordings(folder)
    _periodic(folder)
    texts = {
        "learner.toml": LEARNER_TOML, "mine.py": MINE_PY, "serve.toml": _configuration(),
        "trajectory.csv": "y,v,a\n40,0,0\n40.1,100,0\n40.2,100,0\n",
    }  # fmt: skip
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    save_stage(preset("bouc_wen"), folder / "mystage.toml")


def _configuration() -> str:
    """That of ``dehyst serve --example``, for the model of the examples, with recorder, checkpoints and a standby."""
    text = example().replace('model = "x.npz"', 'model = "stage.npz"')
    text = text.replace("# standby_listen = []", f"standby_listen = [{STANDBY!r}]".replace("'", '"'))
    for key in ("recorder", "checkpoints"):
        text = text.replace(f"# {key} = ", f"{key} = ")
    return text


def _write(path: Path, header: str, *columns: ArrayLike) -> None:
    np.savetxt(path, np.column_stack(columns), delimiter=",", header=header, comments="", fmt="%.9g")


def _recordings(folder: Path) -> None:
    """Recordings of the stage that ``dehyst stage`` simulates."""
    # Many tones over the whole drive: a model of a part of it is wrong at rest.
    tones = multitone(LENGTH_S, DT_S, seed=1)[1]
    drives = {
        "recording": training_input(DT_S, LENGTH_S)[1],
        "train": 8.0 * (tones - tones.min()) / np.ptp(tones),
        "test": generalisation_input(DT_S, LENGTH_S)[1],
    }
    for name, u_V in drives.items():
        t_s, y_um = np.arange(u_V.size) * DT_S, _readings(u_V)
        _write(folder / f"{name}.csv", "t_s,u_V,y_um", t_s, u_V, y_um)
        if name == "recording":
            _write(folder / "scope.csv", "Time,CH1,CH2\nms,V,V", 1e3 * t_s, u_V, 0.1 * y_um)
        if name == "test":
            (folder / "recordings" / "x").mkdir(parents=True)
            columns = {"seq": np.arange(u_V.size), "t_s": t_s, "u_V": u_V, "y_um": y_um}
            segment = pyarrow.table({**columns, "reason": ["learnt"] * u_V.size})
            parquet.write_table(segment, folder / "recordings" / "x" / "segment-000001.parquet")
    period = np.arange(PERIOD) * PERIOD_DT_S
    drive_V = 4.0 - 3.0 * np.cos(4.0 * np.pi * period) + 0.5 * np.sin(40.0 * np.pi * period)
    np.save(folder / "drive.npy", drive_V)
    # The first two periods are the way to the steady state.
    readings = _readings(np.tile(drive_V, PERIODS + 2), PERIOD_DT_S).reshape(PERIODS + 2, PERIOD)[2:]
    np.save(folder / "readings.npy", readings)


def _readings(u_V: FloatArray, dt_s: float = DT_S) -> FloatArray:
    """(n,) readings of the stage, µm, from rest under (n,) voltages."""
    stage = Stage(preset("rich", seed=4, dt_s=dt_s))
    readings: FloatArray = stage.run(stage.initial_state(), u_V)[0]
    return readings


def _periodic(folder: Path) -> None:
    """Recordings for ``dehyst modes``: periods in steady state, realisations of orthogonal phases."""
    for name, rms_V, seed in (("low", 0.1, 1), ("high", 0.3, 2)):
        u_V, y_um = _steady(2, 512, 4, 2, rms_V, seed)
        np.savez(folder / f"{name}.npz", u=u_V, y_um=y_um, fs_hz=1.0 / DT_S)
    u_V, y_um = _steady(3, 8192, 3, 3, 0.2, 5)
    for i, name in enumerate("abc"):
        # Here the periods follow one another.
        u, y_nm = (np.concatenate([*values[:, :, i].transpose(2, 0, 1)]) for values in (u_V, 1e3 * y_um))
        _write(folder / f"{name}.csv", "t_s,CH1,CH2,CH3,X,Y", np.arange(len(u)) * DT_S, u, y_nm)


def _steady(
    drives: int, samples: int, realisations: int, periods: int, rms_V: float, seed: int
) -> tuple[FloatArray, FloatArray]:
    """(samples, drives or 2 outputs, realisations, periods) voltages, V, and readings, µm, of ``MODES``.

    Random phases at all lines below 0.45 of the sample rate; as many realisations as drives are orthogonal.
    """
    rng = np.random.default_rng(seed)
    lines = np.arange(1, round(0.45 * samples))
    spectrum = np.zeros((samples // 2 + 1, drives, realisations), dtype=np.complex128)
    turns = np.exp(2j * np.pi * np.outer(np.arange(drives), np.arange(drives)) / drives)
    for first in range(0, realisations, drives):
        phases = np.exp(2j * np.pi * rng.random((lines.size, drives)))
        spectrum[lines, :, first : first + drives] = phases[:, :, np.newaxis] * turns
    u_V = np.fft.irfft(spectrum, n=samples, axis=0)
    factor = rms_V / np.sqrt(np.mean(u_V**2))
    s = 2j * np.pi * np.arange(samples // 2 + 1) / (samples * DT_S)
    response = np.zeros((s.size, 2, drives), dtype=np.complex128)
    for hertz, damping, falls, gains in MODES:
        omega = 2.0 * np.pi * hertz * (1.0 - falls * rms_V)
        shape = omega**2 / (s**2 + 2.0 * damping * omega * s + omega**2)
        response += shape[:, np.newaxis, np.newaxis] * np.array(gains)[:, :drives]
    y_um = np.fft.irfft(response @ (factor * spectrum), n=samples, axis=0)
    repeated = np.repeat((factor * u_V)[..., np.newaxis], periods, axis=3)
    noise_um = NOISE_UM * rng.standard_normal((*y_um.shape, periods))
    return repeated, y_um[..., np.newaxis] + noise_um
