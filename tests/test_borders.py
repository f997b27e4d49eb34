"""Where a part ends: what looks the same moved or not goes with what it hangs together with."""

import numpy as np
import pytest

from hingesplat.borders import bordered
from hingesplat.labelling import Labelling
from hingesplat.screw import prismatic, revolute
from hingesplat.surface import Labels, Surface
from hingesplat.visibility import Sight

NOBODY = Sight(np.zeros((0, 3, 4)), np.zeros((0, 1, 1), np.float32), np.zeros((0, 1, 1, 3), np.float32), 0.01)
THIRDS = np.repeat([0, 1, 2], 30)
"""Of a strip: must stay, looks the same in either case, moves."""
OWNED = (THIRDS == 2).astype(int)


def strip(gap_after: int, colours: np.ndarray | None = None) -> Surface:
    """A strip of points three wide, whose thirds lie apart after this one."""
    x, y = (a.ravel() for a in np.meshgrid(0.01 * np.arange(30), 0.01 * np.arange(3), indexing="ij"))
    x = x + np.where(gap_after < THIRDS, 0.012, 0)
    points = np.stack([x, y, 0 * x], 1)
    grey = np.full((90, 3), 0.5) if colours is None else colours
    return Surface(points, grey, np.tile([0.0, 0, 1], (90, 1)), np.zeros(90), NOBODY)


def labelled(
    monkeypatch: pytest.MonkeyPatch, surface: Surface, T: np.ndarray, lost: np.ndarray | None = None
) -> Labels:
    moved_cost = np.where(THIRDS == 0, 1.0, 0.0)
    costs = np.stack([np.where(THIRDS == 2, 1.0, 0.0), moved_cost], 1)
    monkeypatch.setattr("hingesplat.labelling.label_costs", lambda *_, **__: costs)
    told = [np.stack([np.ones(90, bool), np.zeros(90, bool) if lost is None else lost])]
    return bordered([T], (OWNED, OWNED), Labelling.of((surface, surface), 1.0), (told, told))


@pytest.mark.parametrize("T", [prismatic([1, 0, 0], 0.2), revolute([0, 0, 1], [0, 0, 0], 0.5)])
@pytest.mark.parametrize("gap_after", [0, 1])
def test_the_border_runs_where_least_hangs_together(
    monkeypatch: pytest.MonkeyPatch, gap_after: int, T: np.ndarray
) -> None:
    for found in labelled(monkeypatch, strip(gap_after), T):
        middle = found[THIRDS == 1]
        assert (middle == 1 - gap_after).mean() > 0.9
        np.testing.assert_array_equal(found[THIRDS == 2], 1)
        np.testing.assert_array_equal(found[:27], 0)


@pytest.mark.parametrize("with_part", [True, False])
def test_it_runs_between_two_colours(monkeypatch: pytest.MonkeyPatch, with_part: bool) -> None:
    dark = THIRDS > 0 if with_part else THIRDS > 1
    surface = strip(2, np.where(dark[:, None], 0.1, 0.8) * np.ones(3))
    for found in labelled(monkeypatch, surface, prismatic([1, 0, 0], 0.2)):
        assert (found[THIRDS == 1] == with_part).mean() > 0.9


def test_what_nobody_would_see_arrive_is_not_asked_about(monkeypatch: pytest.MonkeyPatch) -> None:
    for found in labelled(monkeypatch, strip(0), prismatic([1, 0, 0], 0.2), THIRDS == 1):
        np.testing.assert_array_equal(found, OWNED)
