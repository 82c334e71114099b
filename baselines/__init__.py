"""Reference models of hysteresis to compare the LSSVM with, and the competition that serves the best model.

A linear, a Bouc-Wen and a Prandtl-Ishlinskii (MPI) model, each with identification, exact inverse and an online form::

    >>> import numpy as np
    >>> from dehyst.baselines import fit_linear
    >>> u_V = np.linspace(0.0, 8.0, 50)
    >>> model, report = fit_linear(u_V, 2.0 + 11.0 * u_V, dt_s=1e-3)
    >>> y_um, still = np.array([24.0]), np.zeros(1)
    >>> round(float(model.feedforward(y_um, still, still, model.rest_memory(24.0)).u_V[0]), 6)
    2.0

Names are imported when they are first used, because some of them load compiled code.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dehyst.adaptive.lazy_names import lazy_names

if TYPE_CHECKING:
    from dehyst.baselines.bouc_wen.identify import fit_bouc_wen as fit_bouc_wen
    from dehyst.baselines.linear import fit_linear as fit_linear
    from dehyst.baselines.prandtl_ishlinskii.identify import fit_mpi as fit_mpi

__getattr__ = lazy_names(__name__)
