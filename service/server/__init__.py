"""The serving process: `Service` runs an `AxisServer` for each axis, whose `AxisLoop` is the life of an `Axis`.

`load_axis` makes an axis from its model file.
"""
