"""What dehyst raises. One tree, so that a caller can catch as much or as little as it wants.

::

    DehystError
    ├── InputError        (also ValueError)  a field's value is not what it must be
    ├── ModelFileError                       a file of ours is damaged, foreign or of another version
    ├── NumericsError                        a computation left the finite or its tolerance
    └── ServiceError                         defined in service.protocol.errors: the wire and the processes

Every message names the field, what was got, what was expected and what to do.
"""

from __future__ import annotations


class DehystError(Exception):
    """Root of all errors raised on purpose by this project."""


class InputError(DehystError, ValueError):
    """A value that a user or a peer gave is not acceptable; the message says how to mend it."""


class ModelFileError(DehystError):
    """A model, checkpoint or stage file cannot be used: damaged, foreign, or of another version."""


class NumericsError(DehystError, ArithmeticError):
    """A computation would have left the finite numbers or its stated tolerance, and was refused."""
