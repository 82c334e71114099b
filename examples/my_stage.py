"""The stage of this lab: the one place that knows which controller moves it. The other examples import it.

As it stands it opens the simulated PI controller of examples/simulated_pi.py. Put your own adapter in its place: a
ready one of `service.adapters`, or a class of yours with the methods of `service.adapters.StageAdapter`.
"""

from service.adapters.pi import PiStage

RATE_HZ = 200.0
# What may be applied. Stay inside what your stage and amplifier allow.
LOW_V, HIGH_V = 0.0, 80.0


def open_stage() -> PiStage:
    """The stage, ready to be moved; use it in a `with` block."""
    return PiStage("127.0.0.1", port=50000, axis="1", channel=1, rate_Hz=RATE_HZ)


# Other controllers:
#
# from service.adapters.jena import Nv200Stage  # piezosystem jena NV200; set RATE_HZ = 25
# return Nv200Stage("192.168.0.12", rate_Hz=RATE_HZ)
#
# from service.adapters.ni import NiStage  # a card of National Instruments: ao0 drives an amplifier, ai0 reads a sensor
# return NiStage("Dev1/ao0", "Dev1/ai0", amplifier_gain=10.0, um_per_V=6.0, u_min_V=0.0, u_max_V=100.0, rate_Hz=RATE_HZ)
