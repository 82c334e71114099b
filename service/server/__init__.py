"""The serving process: `Service` runs an `AxisServer` for each axis, whose `AxisLoop` is the life of an `Axis`."""
