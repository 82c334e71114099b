"""Samples on their way to an axis.

`SampleQueue` holds samples and calls between zenoh's threads and that of the axis, `SequenceTracker` checks sample
numbers, and `SampleClock` gives continuous sample times.
"""
