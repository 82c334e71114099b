"""Several online models on the same samples; the best is served.

`Competition` runs and scores them and chooses the champion, `ChampionInverse` is the inverse model that is served. The
names are loaded on first use, because `CompetitionConfig` needs no numerics.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dehyst.adaptive.lazy_names import lazy_names

if TYPE_CHECKING:
    from dehyst.baselines.competition.champion import ChampionInverse as ChampionInverse
    from dehyst.baselines.competition.competition import Competition as Competition
    from dehyst.baselines.competition.config import CompetitionConfig as CompetitionConfig

__getattr__ = lazy_names(__name__)
