"""What a recording holds that the simulation lacks: calibrate, detect, name, extend, measure the gain."""
