"""Several online models on the same samples; the best is served.

`Competition` runs and scores them and chooses the champion, `ChampionInverse` is the inverse model that is served.
`CompetitionConfig` needs no numerics.
"""
