"""Recordings with hidden effects from six kinds of hysteresis, to score `dehyst diagnose`.

``bases`` (hysteresis), ``effects`` (one implementation for each cause of the catalogue), ``noise`` and ``drives`` make
the recordings and import nothing of the project except the scaled excitation of `tests.hidden.excitation`. ``cases``
draws a case from a seed, ``record`` makes its recording, ``score`` judges answers. Run
``python -m tests.hidden.foreign --single 24 --pair 8 --healthy 8``.
"""
