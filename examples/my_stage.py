"""The stage of this lab: the one place that knows which controller moves it. The other programs import it."""

from dehyst.service.adapters.pi import PiStage

RATE_HZ = 100.0
LOW_V, HIGH_V = 0.0, 80.0  # what may be applied: stay inside what your stage and amplifier allow


def open_stage() -> PiStage:
    """The stage, ready to be moved; use it in a `with` block."""
    return PiStage("127.0.0.1", port=50000, axis="1", channel=1, rate_Hz=RATE_HZ)
