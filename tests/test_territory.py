"""One part is one piece: territories of a motion, and what it may not take along."""

import numpy as np
from scipy.spatial import KDTree

from hingesplat.labelling import MAY, Labelling
from hingesplat.surface import Surface
from hingesplat.territory import BARRED, FOREIGN, barred, further, links, territories
from hingesplat.visibility import Sight

NO_SIGHT = Sight(
    np.zeros((0, 3, 4), np.float32), np.zeros((0, 1, 1), np.float32), np.zeros((0, 1, 1, 3), np.float32), 0.0
)
NOBODY = np.full(40, -1)
AWAY = (0.0, 0.3, 0.0)


def patch(centre: tuple[float, float, float] = (0, 0, 0)) -> np.ndarray:
    """(40, 3) grid, 0.03 apart."""
    x, y = np.meshgrid(np.arange(8), np.arange(5))
    return 0.03 * np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1) + centre


def joined(*columns: list[np.ndarray]) -> list[np.ndarray]:
    """Both states' tables of these columns, each given for state 0 and the other."""
    return [np.stack([column[s] for column in columns], 1) for s in (0, 1)]


DOOR = np.arange(40)
BOTH = [np.concatenate([patch(), patch(AWAY)])] * 2
"""A door, and as large a rack apart from it, in both states."""
STAY = [np.full(80, 1.0)] * 2
MEETS = [np.concatenate([DOOR, NOBODY])] * 2
"""The door meets itself under its motion, the rack nothing."""
HIDES = [np.repeat([0.1, 0.5], 40)] * 2
"""The door's motion suits the door, and puts the rack out of sight."""
TREES = KDTree(BOTH[0]), KDTree(BOTH[1])
SURFACE = Surface(BOTH[0], np.full((80, 3), 0.5), np.tile([0.0, 0, 1], (80, 1)), np.zeros(80), NO_SIGHT)


def test_what_lies_apart_and_meets_nothing_is_foreign() -> None:
    costs, partners = joined(STAY, HIDES), joined([NOBODY.repeat(2)] * 2, MEETS)
    number = territories(costs, partners, links(TREES, 1.0), MAY, 20)
    for mine in number:
        assert (mine[:, 0] == 0).all()
        assert (mine[:40, 1] > 0).all() and len(set(mine[:40, 1])) == 1
        assert (mine[40:, 1] == FOREIGN).all()
    # Both states' points that meet lie in one.
    assert number[0][0, 1] == number[1][0, 1]
    # Were the rack to meet itself as well, the motion would have two territories.
    costs, both = joined(STAY, [np.full(80, 0.1)] * 2), joined([NOBODY.repeat(2)] * 2, [np.arange(80)] * 2)
    mine, _ = territories(costs, both, links(TREES, 1.0), MAY, 20)
    assert mine[0, 1] != mine[40, 1] and (mine[:, 1] > 0).all()
    # Of points that had rather stay none lies in a territory.
    mine, _ = territories(joined([np.zeros(80)] * 2, HIDES), partners, links(TREES, 1.0), MAY, 20)
    assert (mine == 0).all()


def test_the_best_territory_is_one_however_little_it_gains() -> None:
    costs, partners = joined(STAY, HIDES), joined([NOBODY.repeat(2)] * 2, MEETS)
    mine, _ = territories(costs, partners, links(TREES, 1.0), MAY, 1e6)
    assert (mine[:40, 1] > 0).all() and (mine[40:, 1] == FOREIGN).all()


def test_two_states_points_that_meet_are_one_piece() -> None:
    """Each state shows another half of a plate, but for what both show in its middle."""
    plate = np.concatenate([patch(), patch(AWAY)])
    first, second = plate[:48], plate[32:]
    trees = KDTree(first), KDTree(second)
    meets = np.concatenate([np.full(32, -1), np.arange(16)]), np.concatenate([np.arange(32, 48), np.full(32, -1)])
    costs = [np.stack([np.ones(48), np.full(48, 0.1)], 1)] * 2
    partners = [np.stack([np.full(48, -1), m], 1) for m in meets]
    apart, together = (
        territories(costs, p, links(trees, 1.0), MAY, 0.1) for p in ([0 * m - 1 for m in partners], partners)
    )
    assert together[0][0, 1] == together[1][0, 1] and together[0][47, 1] == together[1][47, 1] > 0
    assert apart[0][0, 1] != apart[1][0, 1]


def test_a_few_points_are_no_bridge() -> None:
    """A string of points hangs between a door and the rack behind it."""
    string = np.stack([np.full(4, 0.1), np.linspace(0.16, 0.26, 4), np.zeros(4)], 1)
    points = np.concatenate([patch(), patch(AWAY), string])
    costs = [np.stack([np.ones(84), np.concatenate([HIDES[0], np.full(4, 0.5)])], 1)] * 2
    partners = [np.stack([np.full(84, -1), np.concatenate([DOOR, NOBODY, np.full(4, -1)])], 1)] * 2
    joined_by = links((KDTree(points), KDTree(points)), 1.0)
    mine, _ = territories(costs, partners, joined_by, MAY, 20)
    assert (mine[:40, 1] > 0).all() and (mine[40:80, 1] == FOREIGN).all()


def test_further_territories_pay_or_are_left_to_others() -> None:
    """Two doors of one motion, the second of which is hardly better off with it than with another motion."""
    number = [np.repeat([[0, 1, 1], [0, 2, 1]], 40, 0)] * 2
    rival = np.repeat([1.0, 0.3], 40)
    costs, labels = joined(STAY, [np.full(80, 0.1)] * 2, [rival, rival]), (np.ones(80, int), np.ones(80, int))
    gain = 2 * 40 * 0.2
    worthy, away = further(costs, number, labels, gain - 1)
    assert worthy == 1 and not any(a.any() for a in away)
    worthy, away = further(costs, number, labels, gain + 1)
    assert worthy == 0
    for a in away:
        np.testing.assert_array_equal(a, np.repeat([[False, False, False], [False, True, False]], 40, 0))
    alone = [np.repeat([[0, 1, 0], [0, 1, 0]], 40, 0)] * 2
    same = joined(STAY, [np.full(80, 0.1)] * 2, [np.full(80, 0.1)] * 2)
    assert not any(a.any() for a in further(same, alone, labels, 1.0)[1])  # Its only territory, for all it gains.
    for before, after in zip(costs, barred(costs, away), strict=True):
        np.testing.assert_allclose(after - before, BARRED * np.repeat([[0, 0, 0], [0, 1, 0]], 40, 0), atol=1e-6)


def test_a_rack_is_not_the_doors() -> None:
    """Out of sight with the door it would cost half of what it does where it is; but it hangs far from the door."""
    problem = Labelling.of((SURFACE, SURFACE), 1.0)
    costs, partners = joined(STAY, HIDES), joined([NOBODY.repeat(2)] * 2, MEETS)
    number = problem.territories(costs, partners)
    free, settled = problem.mean_field(costs, partners)[0], problem.settled(costs, partners, number)
    for s in (0, 1):
        assert (free[s] == 1).all()
        np.testing.assert_array_equal(settled.labels[s], np.repeat([1, 0], 40))
        assert (settled.costs[s][40:, 1] > BARRED).all() and (settled.costs[s][:40] <= 1).all()
    # A motion of its own has it for itself, and explains what it explains beside to stay, not beside the door's motion.
    own = [np.repeat([1.2, 0.2], 40)] * 2
    costs = joined(STAY, HIDES, own)
    partners = joined([NOBODY.repeat(2)] * 2, MEETS, [np.concatenate([NOBODY, 40 + DOOR])] * 2)
    settled = problem.settled(costs, partners, problem.territories(costs, partners))
    for s in (0, 1):
        np.testing.assert_array_equal(settled.labels[s], np.repeat([1, 2], 40))


def test_where_points_are_denser_each_neighbour_says_less() -> None:
    thinned, dense = (Labelling.of((SURFACE, SURFACE), 1.0, density) for density in (1, 4))
    assert dense.smoothness == thinned.smoothness / 2
