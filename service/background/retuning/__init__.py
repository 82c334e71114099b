"""Re-tuning in the background: a process proposes hyper-parameters and tries them on fresh samples.

`Retuner` controls it for an axis, as `RetuningConfig` says. A `Retuned` is an adoption at a definite sample;
`Adoptions` holds those that an axis has yet to make. The names are loaded on first use: the configuration needs
`RetuningConfig` only.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from adaptive.lazy_names import lazy_names

if TYPE_CHECKING:
    from service.background.retuning.adoption import Adoptions as Adoptions
    from service.background.retuning.adoption import Retuned as Retuned
    from service.background.retuning.retuner import Retuner as Retuner
    from service.background.retuning.settings import RetuningConfig as RetuningConfig

__getattr__ = lazy_names(__name__)
