"""The adaptive inverse model of a piezo stage: an LSSVM that is identified from a recording and learns online.

Identify the inverse of a stage, and follow the stage when its gain has dropped by 10 %:

>>> import numpy as np
>>> from dehyst.adaptive import IdentifyConfig, Learner, Sample, identify_lssvm
>>> dt_s = 1e-3
>>> t_s = np.arange(4000) * dt_s
>>> u_V = 5.0 - 2.0 * np.cos(2.0 * np.pi * t_s) - 2.0 * np.cos(2.0 * np.pi * 2.3 * t_s)
>>> y_um = 10.0 * u_V + 3.0 * np.sin(u_V)
>>> model, report = identify_lssvm(u_V, y_um, dt_s, config=IdentifyConfig(n=100, tune=False))
>>> learner = Learner.from_model(model)
>>> for k in range(4000):
...     gate = learner.handle(Sample(seq=k, t_s=k * dt_s, u_V=u_V[k], y_um=0.9 * y_um[k]))
>>> errors = learner.diagnostics()
>>> errors["rms_error_pct"] < 0.5 * errors["frozen_rms_error_pct"]  # the learnt and the identified model
True
>>> still = np.zeros(1)
>>> answer = learner.snapshot().feedforward(np.array([30.0]), still, still, learner.memory())
>>> answer.u_V.shape, bool(answer.inside[0])  # the voltage for 30 µm at rest, inside the range that was learnt
((1,), True)

`identify_lssvm` returns an `LssvmInverse` and a report of its errors on held-out samples. A `Learner` takes one
`Sample` at a time and offers immutable snapshots, again `LssvmInverse`. The parts are in `adaptive.window` (the sliding
LSSVM), `adaptive.online` (gates, drift filter, learner) and `adaptive.tuning` (the evidence of hyper-parameters).

Names are imported on first use: numba and scipy take seconds, which a process that needs neither should not wait for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dehyst.adaptive.lazy_names import lazy_names

if TYPE_CHECKING:
    from dehyst.adaptive.errors import DehystError as DehystError
    from dehyst.adaptive.errors import InputError as InputError
    from dehyst.adaptive.errors import ModelFileError as ModelFileError
    from dehyst.adaptive.errors import NumericsError as NumericsError
    from dehyst.adaptive.features import FeatureMap as FeatureMap
    from dehyst.adaptive.identification import IdentificationReport as IdentificationReport
    from dehyst.adaptive.identification import IdentifyConfig as IdentifyConfig
    from dehyst.adaptive.identification import identify_lssvm as identify_lssvm
    from dehyst.adaptive.inverse_model import LssvmInverse as LssvmInverse
    from dehyst.adaptive.online.config import LearnerConfig as LearnerConfig
    from dehyst.adaptive.online.learner import Learner as Learner
    from dehyst.adaptive.types import Feedforward as Feedforward
    from dehyst.adaptive.types import InverseModel as InverseModel
    from dehyst.adaptive.types import OnlineModel as OnlineModel
    from dehyst.adaptive.types import Sample as Sample

__getattr__ = lazy_names(__name__)
