"""The Bouc-Wen stage (2.1)-(2.3): ``model``, exact ``step``, ``inverse``, ``identify`` and ``online`` form.

``mechanical`` is the related oscillator whose hysteresis acts in the restoring force.
"""
