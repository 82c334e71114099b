"""An object of a Python file of the user, named on the command line by FILE.py:NAME."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

from dehyst.adaptive.errors import DehystError
from dehyst.service.protocol.errors import FieldError


def load_object(option: str, where: str, example: str) -> object:
    """The object FILE.py:NAME that ``option`` names; the file is run.

    Raises FieldError where file or name is missing, or the file fails.
    """
    file, colon, name = where.rpartition(":")
    if not (colon and file and name.isidentifier()):
        raise FieldError(option, repr(where), "FILE.py:NAME", f"for instance {example}")
    path = Path(file)
    if not path.is_file():
        raise FieldError(option, f"{file}, which is not there", "a Python file")
    spec = importlib.util.spec_from_file_location("dehyst_given", path)
    if spec is None or spec.loader is None:
        raise FieldError(option, file, "a Python file, its name ending in .py")
    module = importlib.util.module_from_spec(spec)
    # As for a script, imports from its folder work, and the module can be found by its name.
    sys.modules[spec.name] = module
    sys.path.insert(0, str(path.resolve().parent))
    try:
        spec.loader.exec_module(module)
    except DehystError:
        raise
    except Exception as error:
        raise FieldError(
            option, f"{file}: {type(error).__name__}: {error}", "a file that Python runs to its end", "correct the file"
        ) from error
    if not hasattr(module, name):
        known = [key for key, value in vars(module).items() if not key.startswith("_") and callable(value)]
        raise FieldError(option, f"{name!r}, which is not in {file}", f"one of {', '.join(known) or 'nothing there'}")
    found: object = getattr(module, name)
    return found
