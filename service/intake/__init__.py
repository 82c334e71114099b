"""Samples on their way into an axis: the queue, the numbers of the samples, and their times."""
