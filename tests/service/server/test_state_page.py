"""The page of the state says what is declared."""

from __future__ import annotations

from benchmarks.forged_states import make_axis, recording
from dehyst.service.server.state_page import page


def test_every_entry_of_an_axis_that_learns_is_on_the_page() -> None:
    axis = make_axis(alone=True)
    axis.handle(recording(0, 500))
    told = page()
    # Settings are on the page of the configuration; records in tables of their own; names of models and outcomes.
    apart = ("learner.config.", "learner.base.", "learner.frozen", "model.", "memory.", "gates.")
    for name in axis.state_dict():
        if not name.startswith(apart) and ".features." not in name and ".served." not in name:
            group = name.rpartition(".")[0]
            named = f"\n{name} " in told or f"\n{group}.NAME " in told or name.rpartition(".")[2] in told
            assert named, name
