"""Pictures of the measured stack and of the Bouc-Wen benchmark."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lab.reproduce.measured import WINDOWS, Benchmark, Stack
from service.reports.plot_style import colour, figure, label, line, save

_NAMES = {"lssvm_frozen": "lssvm", "lssvm_adaptive": "lssvm_memory", "lssvm_adaptive_online": "lssvm_memory"}


def stack_figure(path: Path, found: Stack) -> Path:
    """The test recording, the models' equivalent errors along it, and both published windows."""
    drawn, axes = figure(3, 1, (10, 9), "Measured stack actuator: the ramped sine, on which nothing was identified")
    line(axes[0, 0], found.t_s, found.y_um - np.mean(found.y_um), color="black", label="measured")
    for name, (start, stop, _) in WINDOWS.items():
        axes[0, 0].axvspan(found.t_s[start], found.t_s[min(stop, found.t_s.size - 1)], alpha=0.2, color="#E69F00")
        axes[0, 0].text(found.t_s[start], 20.0, name, fontsize=8)
    label(axes[0, 0], "time / s", "displacement / µm", "a  recording and the windows that its authors report on")
    for result in found.results:
        if result.score is None or result.name in ("linear", "lssvm_frozen"):
            continue
        shade = colour(_NAMES.get(result.name, result.name))
        dash = "--" if result.name.endswith("_online") else "-"
        style = {"color": shade, "linestyle": dash, "linewidth": 0.6}
        error = result.error_V * found.gain_um_per_V
        line(axes[1, 0], found.t_s, error, label=f"{result.name}: {result.score.rmse_um:.3f} µm RMSE", **style)
    axes[1, 0].set_ylim(-4.0, 4.0)
    axes[1, 0].legend(fontsize=8, ncols=2)
    label(axes[1, 0], "time / s", "equivalent error / µm", "b  errors of the inverse models (dashed: learning)")
    models = [model for model in found.models if not model.failed]
    at = np.arange(len(models))
    for i, name in enumerate(WINDOWS):
        axes[2, 0].bar(at + 0.4 * (i - 0.5), [m.windows_um[name] for m in models], 0.38, label=f"window: {name}")
    for (start, stop, value), dash in zip(WINDOWS.values(), ("--", ":"), strict=True):
        text = f"published, rows {start} to {stop - 1}: {value} µm"
        axes[2, 0].axhline(value, color="black", linestyle=dash, linewidth=1.0, label=text)
    axes[2, 0].set_xticks(at, [m.name for m in models], fontsize=8, rotation=12)
    axes[2, 0].legend(fontsize=8)
    label(axes[2, 0], "", "RMSE / µm", "c  in the published windows, mean removed")
    return save(drawn, path)


def benchmark_figure(path: Path, found: Benchmark, rate_Hz: float = 750.0) -> Path:
    """Prediction of the test multisine, what is left of it, and over which frequencies."""
    drawn, axes = figure(3, 1, (10, 8), "Bouc-Wen benchmark: forward prediction of the test multisine")
    n = 750
    t_s = np.arange(n) / rate_Hz
    axes[0, 0].plot(t_s, 1e3 * found.test_y_m[:n], color="black", linewidth=1.0, label="test")
    axes[0, 0].plot(t_s, 1e3 * found.test_model_m[:n], color="#E69F00", linewidth=0.8, linestyle="--", label="model")
    axes[0, 0].legend(fontsize=8)
    label(axes[0, 0], "time / s", "displacement / mm", "a  the first second")
    whole = np.arange(found.test_y_m.size) / rate_Hz
    axes[1, 0].plot(whole, 1e6 * (found.test_model_m - found.test_y_m), color="#D55E00", linewidth=0.4)
    label(axes[1, 0], "time / s", "error / µm", f"b  model less test: RMSE {1e6 * found.rmse_m:.3f} µm")
    frequency, amplitude = found.residual_spectrum
    axes[2, 0].semilogy(frequency[1:], np.abs(np.fft.rfft(found.test_y_m))[1:] * 2 / whole.size, color="black", lw=0.5)
    axes[2, 0].semilogy(frequency[1:], amplitude[1:], color="#D55E00", linewidth=0.5)
    label(axes[2, 0], "frequency / Hz", "amplitude / m", "c  spectrum of the test (black) and of the error")
    return save(drawn, path)
