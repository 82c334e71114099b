"""The modified Prandtl-Ishlinskii model (MPI), equations (2.4)-(2.18).

`MpiParameters` is the model, `identify_mpi` identifies it over an `MpiGrid`, `MpiInverse` is its exact inverse and
`MpiOnline` adapts it; `operators` has the play and dead-zone operators. The names are loaded on first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dehyst.adaptive.lazy_names import lazy_names

if TYPE_CHECKING:
    from dehyst.baselines.prandtl_ishlinskii.identify import MpiGrid as MpiGrid
    from dehyst.baselines.prandtl_ishlinskii.identify import identify_mpi as identify_mpi
    from dehyst.baselines.prandtl_ishlinskii.model import MpiInverse as MpiInverse
    from dehyst.baselines.prandtl_ishlinskii.model import MpiParameters as MpiParameters
    from dehyst.baselines.prandtl_ishlinskii.online import MpiOnline as MpiOnline

__getattr__ = lazy_names(__name__)
