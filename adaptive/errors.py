"""The exceptions of dehyst: one tree, so that a caller can catch a single kind or all of them.

::

    DehystError
    ├── InputError        (also ValueError)  the value of a field is not acceptable
    ├── ModelFileError                       a file is damaged, foreign or of another version
    ├── NumericsError                        a computation left the finite numbers or its tolerance
    └── ServiceError                         defined in service.protocol.errors: the wire and the processes

Every message names the field, the value, what was expected and what to do.
"""

from __future__ import annotations


class DehystError(Exception):
    """Root of all errors raised on purpose by this project."""


class InputError(DehystError, ValueError):
    """A value from a user or a peer is not acceptable; the message says how to correct it."""


class ModelFileError(DehystError):
    """A model, checkpoint or stage file cannot be used: damaged, foreign, or of another version."""


class NumericsError(DehystError, ArithmeticError):
    """A computation would have left the finite numbers or its stated tolerance, and was refused."""
