"""A payload on the stage: the known mode moves to ``f0 sqrt(m/(m+M))``, the DC gain does not.

It multiplies the mass of `resonance` or `mechanics` in the same chain; a chain without either is refused.
"""

from __future__ import annotations

from sim.effects.base import Kind, Parameter, Place

KIND = Kind(
    name="payload_change",
    place=Place.MECHANICS,
    parameters=(Parameter("payload_ratio", "1", 0.0, 20.0, 1.0, "added mass relative to the moved mass"),),
    derive=lambda values, context: (),
    block=None,
    signature="the known mode moves, the DC gain does not",
    mistaken_for=("resonance",),
    tells_apart="a change of stiffness moves the DC gain too",
    source="-30 % of f0 when the mass doubles: f0 sqrt(m/(m+M))",
)
