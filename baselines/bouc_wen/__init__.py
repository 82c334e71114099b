"""The Bouc-Wen stage, equations (2.1)-(2.3).

`BoucWenParameters` is the model, `step.hysteresis_step` its exact step, `identify_bouc_wen` identifies it,
`BoucWenInverse` inverts it and `BoucWenOnline` adapts it. The names are loaded on first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dehyst.adaptive.lazy_names import lazy_names

if TYPE_CHECKING:
    from dehyst.baselines.bouc_wen.identify import identify_bouc_wen as identify_bouc_wen
    from dehyst.baselines.bouc_wen.model import BoucWenInverse as BoucWenInverse
    from dehyst.baselines.bouc_wen.model import BoucWenParameters as BoucWenParameters
    from dehyst.baselines.bouc_wen.online import BoucWenOnline as BoucWenOnline

__getattr__ = lazy_names(__name__)
