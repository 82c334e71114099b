"""Nested states as flat entries, whose names have the prefix of their part."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from adaptive.types import StateDict


def prefixed(prefix: str, state: Mapping[str, Any]) -> StateDict:
    """The same entries under prefixed names."""
    return {f"{prefix}{name}": value for name, value in state.items()}


def under(prefix: str, state: Mapping[str, Any]) -> StateDict:
    """The entries whose names begin with ``prefix``, without it: the inverse of ``prefixed``."""
    return {name[len(prefix) :]: value for name, value in state.items() if name.startswith(prefix)}


def joined(parts: Mapping[str, Mapping[str, Any]]) -> StateDict:
    """The entries of several states, each under ``NAME.``."""
    return {f"{part}.{name}": value for part, state in parts.items() for name, value in state.items()}
