"""Stages that are ready to use: ``preset("rich")`` replaces hardware, ``preset("bouc_wen")`` is the chapter's stage.

Sources: section 2.2 of the chapter (a P-734.2CL class stage of 100 µm, 16-bit converters, 88 to 90 µm for about 8 V,
cross-talk 1.17 %), Table 2.1, and the magnitudes stated by each effect.
"""

from __future__ import annotations

import dataclasses
from typing import Any

from dehyst.adaptive.errors import InputError
from dehyst.sim.effects import Chain, effect
from dehyst.sim.stage.config import StageConfig


def rich_chain() -> Chain:
    """One axis of the stage that replaces hardware. It is outside the class of every model that is fitted to it.

    Hysteresis: sixty generalised plays with uneven weights, asymmetric envelopes and rate-dependent thresholds, and a
    smooth part without return-point memory; the loop height is about 12 % of a full stroke and 2 % small-signal
    (manufacturers' tutorials: 10 to 15 % and 2 %). Creep: 1.5 % per decade over four decades of time. One mode at
    450 Hz with damping 0.05, amplifier corner 2.5 kHz, sensor lag 0.3 ms, noise of a reading 5 nm, 16-bit converters,
    slow drift of offset and gain.
    """
    return Chain(
        (
            effect("dac", bits=16, span_V=20.0),
            effect("amplifier_lag", tau_s=6.4e-5),
            effect("saturation", low_V=-3.0, high_V=12.0),
            effect(
                "generalised_play",
                linear_um_per_V=6.85,
                square_um_per_V2=-0.02,
                play_um_per_V=5.2,
                largest_V=3.0,
                spread_V=2.0,
                lower_slope=0.12,
                upper_slope=-0.10,
                rate_growth_V=0.05,
                rate_corner_V_per_s=20.0,
                rate_tau_s=0.004,
            ),
            effect("duhem", slope_um_per_V=0.25, square_um_per_V2=0.004, stiffness_per_V=0.9, start_share=0.15),
            effect("creep", gain_per_decade=0.015, t0_s=0.1),
            effect("resonance", frequency_Hz=450.0, damping_ratio=0.05, payload_ratio=0.0),
            effect("cross_talk", static=0.0117, rate_s=2e-6),
            effect("thermal_drift", amplitude_um=0.15, tau_s=1800.0, walk_um_per_sqrt_min=0.004),
            effect("gain_drift", ramp_per_min=0.0, amplitude=0.002, tau_s=3600.0, walk_per_sqrt_min=5e-5),
            effect("sensor_noise", rms_um=0.0065),
            effect("sensor_lag", tau_s=3e-4),
            effect("quantisation", step_um=100.0 / 65536),
        )
    )


def rich(*, seed: int = 0, dt_s: float = 1e-3) -> StageConfig:
    """The default stage: two axes that are equal except for their noise, about 89 µm for 0 to 8 V."""
    chain = rich_chain()
    return StageConfig("rich", chain, chain, dt_s=dt_s, seed=seed, u_min_V=-2.0, u_max_V=10.0)


def bouc_wen(*, seed: int = 0, dt_s: float = 1e-3) -> StageConfig:
    """The chapter's identified stage, (2.1) and (2.2) with Table 2.1, noise of 5 nm and 16-bit converters.

    The D/A converter holds the voltage and there is no amplifier, so ``u`` jumps at each sample. ``h`` and the
    overdamped mechanics follow in closed form.
    """
    chain = Chain(
        (
            effect("dac", bits=16, span_V=20.0),
            effect("bouc_wen"),
            effect("mechanics"),
            effect("sensor_noise", rms_um=0.005),
            effect("quantisation", step_um=100.0 / 65536),
        )
    )
    return StageConfig("bouc_wen", chain, None, dt_s=dt_s, seed=seed, u_min_V=-2.0, u_max_V=10.0)


PRESETS = {"rich": rich, "bouc_wen": bouc_wen}


def preset(name: str, **changes: Any) -> StageConfig:
    """A preset by name, with other values of `StageConfig` fields. Raises InputError on an unknown name or field."""
    if name not in PRESETS:
        raise InputError(f"preset: got {name!r}, expected one of: {', '.join(PRESETS)}")
    fields = {f.name for f in dataclasses.fields(StageConfig)}
    for field in changes:
        if field not in fields:
            raise InputError(
                f"preset {name}: got {field!r}, expected a field of StageConfig: {', '.join(sorted(fields))}"
            )
    return dataclasses.replace(PRESETS[name](), **changes)
