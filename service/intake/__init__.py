"""Samples on their way to an axis.

`SampleQueue` holds samples and calls between zenoh's threads and that of the axis, `SequenceTracker` checks sample
numbers, and `SampleClock` gives continuous sample times. The names are loaded on first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dehyst.adaptive.lazy_names import lazy_names

if TYPE_CHECKING:
    from dehyst.service.intake.sample_queue import SampleQueue as SampleQueue
    from dehyst.service.intake.sequence import SampleClock as SampleClock
    from dehyst.service.intake.sequence import SequenceTracker as SequenceTracker

__getattr__ = lazy_names(__name__)
