"""Compile every compiled loop once, so that no process pays for it at start: ``python -m adaptive.warm``."""

from __future__ import annotations


def main() -> None:
    """Nothing to compile yet."""


if __name__ == "__main__":
    main()
