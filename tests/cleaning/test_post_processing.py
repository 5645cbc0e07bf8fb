import numpy as np

from unghost.cleaning.post_processing import decide, limit_removal, optical_depth, removed_regions


def scene():
    """A floor, a floater, and a score that says "occupied" of both."""
    occupied = np.zeros((20, 20, 20), bool)
    occupied[:, :, :3] = True
    occupied[8:12, 8:12, 10:14] = True
    return occupied, np.where(occupied, 0.8, -0.8).astype(np.float32)


def test_votes_remove_and_nothing_else_does():
    occupied, score = scene()
    removed, faint = decide(occupied, occupied, score, threshold=0.0, smallest=27, speck=8)
    assert not removed.any()
    assert not faint.any()
    score[8:12, 8:12, 10:14] = -0.5
    removed, _ = decide(occupied, occupied, score, threshold=0.0, smallest=27, speck=8)
    assert removed.sum() == 64
    assert removed[8:12, 8:12, 10:14].all()
    removed, _ = decide(occupied, occupied, score, threshold=-0.6, smallest=27, speck=8)
    assert not removed.any()


def test_a_piece_mostly_voted_empty_goes_whole_but_the_scene_does_not():
    occupied, score = scene()
    score[8:12, 8:12, 11:14] = -0.5  # three of its four layers
    score[:, :12, :3] = -0.5  # most of the floor
    removed, _ = decide(occupied, occupied, score, threshold=0.0, smallest=0, speck=0)
    assert removed[8:12, 8:12, 10:14].all()
    assert removed[:, :12, :3].all()
    assert not removed[:, 12:, :3].any()


def test_pores_of_a_solid_stay_and_crumbs_go():
    occupied, score = scene()
    score[4, 4, 1:3] = -0.5  # two cells of the floor
    removed, _ = decide(occupied, occupied, score, threshold=0.0, smallest=27, speck=8)
    assert not removed.any()
    removed, _ = decide(occupied, occupied, score, threshold=0.0, smallest=27, speck=0)
    assert removed.sum() == 2
    removed, _ = decide(occupied, occupied, score, threshold=0.0, smallest=65, speck=8)
    assert removed.sum() == 64  # the floater has fewer than 65 cells


def test_faint_cells_go_unless_they_touch_what_stays():
    occupied, score = scene()
    judged = np.ones_like(occupied)
    removed, faint = decide(occupied, judged, score, threshold=0.0, smallest=27, speck=8)
    assert not removed.any()
    assert not (faint & occupied).any()
    assert not faint[:, :, 3].any()  # the floor's skirt
    assert faint[0, 0, 4:].all()
    assert not faint[7:13, 7:13, 9:15].any()


def test_the_soft_skirt_of_what_stays_stays():
    occupied, score = scene()
    score[:, :, 1:3] = -0.5  # two of the floor's three layers
    score[8:12, 8:12, 10:14] = -0.5
    for fringe, layers in ((0, 2), (1, 1), (2, 0)):
        removed, _ = decide(occupied, occupied, score, threshold=0.0, smallest=27, speck=8, fringe=fringe)
        assert removed[:, :, :3].sum() == 400 * layers
        assert removed[8:12, 8:12, 10:14].all()


def test_regions_by_hand():
    removed = np.zeros((6, 6, 6), bool)
    removed[0:2, 0:2, 0:2] = removed[5, 5, 4:6] = True
    score = np.full(removed.shape, -0.5, np.float32)
    regions, count = removed_regions(removed, score, np.array([1.0, 2.0, 3.0]), 0.5)
    assert count == 2
    assert regions[0] == {"voxels": 8, "volume": 1.0, "box": [[1, 2, 3], [2, 3, 4]], "confidence": 0.75}
    assert regions[1]["box"] == [[3.5, 4.5, 5.0], [4.0, 5.0, 6.0]]
    assert removed_regions(np.zeros((2, 2, 2), bool), score[:2, :2, :2], np.zeros(3), 1.0) == ([], 0)


def test_optical_depth_by_hand():
    # light that gets through: all, 1/e, 1 %, nothing
    signed = np.array([-1.0, 1 - 2 / np.e, 0.98, 1.0], np.float32)
    np.testing.assert_allclose(optical_depth(signed), [0, 1, np.log(100), np.log(100)], rtol=1e-4, atol=1e-7)


def test_a_budget_takes_the_most_certain_cells_first():
    rng = np.random.default_rng(0)
    removed, score = rng.random((6, 7, 8)) < 0.5, rng.uniform(-1, 1, (6, 7, 8)).astype(np.float32)
    depth = rng.random((6, 7, 8))
    before = removed.copy()
    for share in (0.0, 0.2, 0.7, 1.0):
        most = share * depth[removed].sum()
        limited = limit_removal(removed, score, depth, most=most)
        assert not (limited & ~removed).any()
        assert depth[limited].sum() <= most * (1 + 1e-9)
        left = removed & ~limited
        if left.any() and limited.any():
            assert score[limited].max() <= score[left].min()
        if left.any():  # no further cell fits
            first = np.flatnonzero(left)[np.argmin(score[left])]
            assert depth[limited].sum() + depth.ravel()[first] > most
    np.testing.assert_array_equal(limited, removed)
    np.testing.assert_array_equal(removed, before)
