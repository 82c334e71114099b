"""The simulated mirror: what its actuators and its face plate do."""

from __future__ import annotations

import numpy as np
import pytest

from dehyst.adaptive.errors import InputError
from dehyst.sim.mirror import Mirror, MirrorConfig, Wavefront

SMALL = MirrorConfig(side=6, seed=3)


def test_the_way_back_differs_from_the_way_there_and_each_actuator_from_the_others() -> None:
    mirror = Mirror(SMALL)
    state, seen = mirror.initial_state(), []
    for u in (*np.linspace(0.0, 8.0, 200), *np.linspace(8.0, 4.0, 100)):
        mirror.step(state, np.full(36, u))
        seen.append(state.stroke_um.copy())
    there, back = seen[99], seen[-1]
    loop = (back - there) / seen[199]
    assert np.all((loop > 0.01) & (loop < 0.3))
    assert np.std(seen[199]) / np.mean(seen[199]) == pytest.approx(SMALL.gain_spread, rel=0.5)


def test_a_neighbour_moves_the_surface_by_the_coupling_and_strokes_invert_it() -> None:
    mirror = Mirror(SMALL)
    one = np.zeros(36)
    one[14] = 1.0
    surface = mirror.surface(one)
    assert surface[2, 2] == 1.0
    assert surface[2, 3] == pytest.approx(SMALL.coupling)
    assert surface[5, 5] == 0.0
    wave = Wavefront(6).at(np.array([0.0, 0.01]))
    strokes = mirror.strokes(wave)
    np.testing.assert_allclose(mirror.surface(strokes[1]).ravel(), wave[1], atol=1e-12)


def test_what_it_cannot_do_is_refused_by_name() -> None:
    with pytest.raises(InputError, match="side: got 1"):
        MirrorConfig(side=1)
    with pytest.raises(InputError, match=r"coupling: got 0\.5"):
        MirrorConfig(coupling=0.5)
    mirror = Mirror(SMALL)
    with pytest.raises(InputError, match="u_V: got shape"):
        mirror.step(mirror.initial_state(), np.full(36, np.nan))
