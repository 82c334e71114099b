"""How a diagnosis speaks of numbers."""

from __future__ import annotations

#: Units by the end of a number's name, as written for people.
_UNITS = {
    "_um_per_s": " µm/s", "_um_per_V": " µm/V", "_per_s": " /s", "_V_per_s": " V/s", "_um": " µm", "_hz": " Hz",
    "_Hz": " Hz", "_V": " V", "_s": " s", "_ppm": " ppm", "_per_K": " /K", "_um_per_K": " µm/K",
    "_per_um": " /µm",
}  # fmt: skip


def length(value_um: float) -> str:
    """A length with the unit that suits it."""
    return f"{1e3 * value_um:.3g} nm" if abs(value_um) < 1.0 else f"{value_um:.3g} µm"


def with_unit(name: str, value: float) -> str:
    """A number of a cause with the unit that its name ends in."""
    for end in sorted(_UNITS, key=len, reverse=True):
        if name.endswith(end):
            return f"{value:.4g}{_UNITS[end]}"
    return f"{value:.4g}"


def plain(name: str) -> str:
    """A cause's name for a sentence."""
    return name.replace("_", " ")
