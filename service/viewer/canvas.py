"""What a scene is drawn on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from adaptive.types import FloatArray
from service.viewer import style
from service.viewer.feed import IntArray


class Canvas(Protocol):
    """Something that draws. Times in s of the stage, with the sequence number of the newest sample then."""

    def scalars(self, path: str, t_s: FloatArray, seq: IntArray, values: FloatArray) -> None: ...
    def strips(
        self, path: str, t_s: float, seq: int, strips: Sequence[FloatArray], colour: style.Colour, radius: float
    ) -> None: ...
    def points(
        self,
        path: str,
        t_s: float,
        seq: int,
        positions: FloatArray,
        colour: style.Colour,
        radius: float,
        labels: Sequence[str] | None = None,
    ) -> None: ...
    def text(self, path: str, t_s: float, seq: int, text: str, level: str) -> None: ...
    def document(self, path: str, t_s: float, seq: int, markdown: str) -> None: ...
