"""What gets the samples behind the intake of an axis: what keeps them, and what finds out what has changed."""

from __future__ import annotations

from typing import Any, Protocol

from numpy.typing import ArrayLike

from service.protocol.samples import SampleBatch


class SampleSink(Protocol):
    """What keeps samples: the recorder. None of these may block or raise."""

    def put(self, seq: ArrayLike, t_s: ArrayLike, u_V: ArrayLike, y_um: ArrayLike, reason: str | list[str]) -> bool:
        """Take n samples with what the learner said of each; False if they were dropped."""
        ...

    def counters(self) -> dict[str, Any]:
        """For the status."""
        ...

    def close(self, timeout_s: float = ...) -> bool:
        """Write what waits and end."""
        ...


class SampleWatcher(Protocol):
    """What watches an axis and finds out what has changed: the diagnosis in the background. Nothing here may block."""

    def take(self, batch: SampleBatch) -> None:
        """Samples that were handled; from the thread that handles them."""
        ...

    def tick(self, now_s: float) -> None:
        """Start what is due; from the thread that publishes."""
        ...

    def request(self, arguments: dict[str, Any]) -> dict[str, Any]:
        """Begin to diagnose now; from any thread."""
        ...

    def status(self) -> dict[str, Any]:
        """For the status."""
        ...

    def close(self) -> None:
        """End what runs."""
        ...
