"""Recordings with a hidden effect, made without anything of ``sim``: the diagnosis must find what is in them.

Nothing here imports the project. Formulas, discretisation and hysteresis class differ from ``sim/effects`` on
purpose: the stage is integrated at eight times the sample rate, creep is the logarithmic law itself (a
convolution), lags are bilinear filters, resonances are modal filters with pre-warping.
"""
