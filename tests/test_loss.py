"""theory.md §12 in shape: in heavy clutter tight association loses far fewer tracks."""

import numpy as np

from waldnet.common.config import load_scenario
from waldnet.scenarios.catalogue import find
from waldnet.studies.modes import play
from waldnet.studies.worlds import draw


def test_tight_association_loses_far_fewer_tracks_in_heavy_clutter() -> None:
    scenario = load_scenario(find("heavy-clutter"))
    worlds = draw(scenario, np.arange(60))
    factor, tight = (play(scenario, mode, worlds) for mode in ("federated", "federated-tight"))
    lost = [
        np.linalg.norm(course.x[:, -1, :2] - worlds.truth[:, -1, :2], axis=-1) > scenario.study.lost_beyond
        for course in (factor, tight)
    ]
    # Seen in 200 runs: 29 % and 4 %. With 60 runs each, both lines hold with more than 99 %.
    assert lost[0].sum() >= 9
    assert 2 * lost[1].sum() <= lost[0].sum()
    assert tight.log_lr[:, -1].mean() > factor.log_lr[:, -1].mean()
