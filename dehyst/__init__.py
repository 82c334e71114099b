"""Takes the hysteresis out of piezo stages, and keeps it out.

What most programs need is here:

- `Client`: asks a service for voltages, and follows its model.
- `Learner`: learns from samples inside a program of one's own; `Sample` is what it takes.
- `identify`: the inverse model of a stage from voltages and displacements.
- `diagnose`: what a simulation gets wrong on a recording, and the cause.

The parts: `dehyst.adaptive` (the inverse model and its learner), `dehyst.baselines`, `dehyst.sim` (simulated stage,
recordings, diagnosis), `dehyst.service` (server, clients), `dehyst.lab` (commands, experiments).
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dehyst.adaptive.inverse_model import LssvmInverse
    from dehyst.adaptive.online.learner import Learner as Learner
    from dehyst.adaptive.types import FloatArray
    from dehyst.adaptive.types import Sample as Sample
    from dehyst.service.client.client import Client as Client
    from dehyst.sim.diagnosis import Diagnosis
    from dehyst.sim.recordings import Recording

__all__ = ["Client", "Learner", "Sample", "diagnose", "identify"]

# In a checkout the parts lie beside this folder, in an installation within it.
if (Path(__file__).parents[1] / "pyproject.toml").is_file():
    __path__.append(str(Path(__file__).parents[1]))

#: Loaded at their first use: numba and scipy take seconds, which a client should not wait for.
_WHERE = {
    "Client": "dehyst.service.client.client",
    "Learner": "dehyst.adaptive.online.learner",
    "Sample": "dehyst.adaptive.types",
}


def __getattr__(name: str) -> object:
    if name not in _WHERE:
        raise AttributeError(f"module 'dehyst' has no attribute {name!r}")
    return getattr(import_module(_WHERE[name]), name)


def identify(u_V: FloatArray, y_um: FloatArray, dt_s: float) -> LssvmInverse:
    """The inverse model of a stage from (n,) voltages V and displacements µm, ``dt_s`` seconds apart.

    A `Learner` starts from it: ``Learner.from_model(identify(u_V, y_um, dt_s))``. Raises DehystError, which names what
    was got and what was expected. More choices: `dehyst.adaptive.identification.identify_lssvm`.
    """
    from dehyst.adaptive.identification import identify_lssvm

    return identify_lssvm(u_V, y_um, dt_s)[0]


def diagnose(recording: str | Path | Recording, test: str | Path | Recording | None = None) -> Diagnosis:
    """What the chapter's stage gets wrong on a recording (a file, or one that was read), and its causes.

    ``test``: another recording of the same stage, on which the errors are taken. Takes up to minutes. Raises
    DehystError if a recording cannot be read or diagnosed. More choices: `dehyst.sim.diagnosis.prepare`.
    """
    from dehyst.sim.diagnosis import diagnose_prepared, prepare
    from dehyst.sim.recordings import read

    recording = read(recording) if isinstance(recording, str | Path) else recording
    test = read(test) if isinstance(test, str | Path) else test
    return diagnose_prepared(prepare(recording, test=test))
