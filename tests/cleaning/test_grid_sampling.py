"""What ``clean`` sees of a field does not depend on how little of it is asked."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from unghost.cleaning.grid_sampling import survey_field
from unghost.cleaning.pipeline import clean
from unghost.cleaning.queries import make_query
from unghost.core.occupancy import OccupancyRule
from unghost.fields.adapters.grids import cell_centers, grid_density_fn

RULE = OccupancyRule()


def surveyed(density, probe, *, boxes=(), drop_invalid=False, rows=1 << 18):
    box = np.array([[0.0, 0.0, 0.0], density.shape])
    query = make_query(grid_density_fn(density, box), place=box.mean(axis=0), caller="clean")
    return survey_field(
        query,
        box,
        1.0,
        density.shape,
        rule=RULE,
        faint=0.1,
        opaque_pitch=1.0,
        soft=True,
        keep_boxes=boxes,
        probe=probe,
        drop_invalid=drop_invalid,
        rows=rows,
    )


@settings(max_examples=60, deadline=None)
@given(st.tuples(*[st.integers(1, 13)] * 3), st.integers(0, 2**32 - 1), st.integers(0, 30), st.integers(1, 2000))
def test_nothing_of_a_grid_is_missed_however_thin(shape, seed, count, rows):
    rng = np.random.default_rng(seed)
    density = np.zeros(shape, dtype=np.float32)
    density.flat[rng.integers(0, density.size, count)] = rng.choice([0.02, 0.3, 50.0], count)
    everywhere, probed = surveyed(density, 1, rows=rows), surveyed(density, 2, rows=rows)
    for name in ("occupied", "judged"):
        assert (getattr(everywhere, name) == getattr(probed, name)).all()
    np.testing.assert_allclose(probed.signed, everywhere.signed, atol=0.02)  # cells that are not judged, at most
    assert (everywhere.signed == probed.signed)[everywhere.judged].all()
    assert everywhere.asked == density.size
    part = everywhere.extent()
    assert everywhere.judged.sum() == everywhere.judged[part].sum()
    if everywhere.judged.any():
        inside = everywhere.judged[part]
        assert all(inside.take(end, axis=axis).any() for axis in range(3) for end in (0, -1))


def test_empty_space_is_told_from_an_eighth_of_its_cells():
    density = np.zeros((64, 32, 32), dtype=np.float32)
    density[4:10, 8:20, 8:20] = 3.0
    probed = surveyed(density, 2)
    assert density.size / 8 < probed.asked < density.size / 8 + 14 * 20 * 20
    assert surveyed(np.zeros_like(density), 4).asked == density.size / 64


def test_large_blocks_miss_what_is_small_and_alone():
    density = np.zeros((32, 32, 32), dtype=np.float32)
    density[3, 3, 3] = 50.0
    assert surveyed(density, 2).judged.sum() == 1
    assert surveyed(density, 8).judged.sum() == 1  # its block's middle touches it
    density[3, 3, 3], density[1, 1, 1] = 0.0, 50.0
    assert not surveyed(density, 8).judged.any()


def test_a_sheet_thinner_than_a_block_is_seen_by_asking_everywhere_and_stays_otherwise(kit):
    box = np.array([[0.0, 0.0, 0.0], [32.0, 32.0, 32.0]])

    def sheet(positions):  # about the middles of one layer of cells, between two layers of probes
        return 5.0 * (np.abs(positions[:, 2] - 16.5) < 0.4)

    options = {"denoiser": kit.numpy_denoiser(kit.all_empty), "field_pitch": 1.0}
    seen, missed = (clean(sheet, box, probe=probe, **options) for probe in (1, 2))
    assert (~seen.cells).sum() == 32 * 32
    assert missed.cells.all()
    assert missed.details["occupied"] == 0


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1.0])
def test_invalid_densities_are_found_in_empty_space(bad):
    box = np.array([[0.0, 0.0, 0.0], [20.0, 20.0, 20.0]])
    holes = (cell_centers(box, (20, 20, 20)) < 6).all(axis=-1)

    def density_fn(positions):
        return np.where((positions < 6).all(axis=-1), bad, 0.0)

    query = make_query(density_fn, place=box.mean(axis=0), caller="clean")
    options = {"rule": RULE, "faint": 0.1, "opaque_pitch": 1.0, "soft": True, "keep_boxes": (), "probe": 2, "rows": 500}
    found = survey_field(query, box, 1.0, (20, 20, 20), drop_invalid=True, **options)
    assert found.dropped == holes.sum()
    assert not found.judged.any()
    with pytest.raises(ValueError, match=r"clean: densities must be finite .* >= 0"):
        survey_field(query, box, 1.0, (20, 20, 20), drop_invalid=False, **options)


def test_keep_boxes_and_cells_beyond_the_box():
    density = np.full((6, 6, 6), 2.0, dtype=np.float32)
    found = surveyed(density, 2, boxes=([[0, 0, 0], [2, 6, 6]],))
    assert found.protected.sum() == 2 * 36
    box = np.array([[0.0, 0.0, 0.0], [3.2, 3.2, 3.2]])  # four cells, the outer ones' middles beyond the box
    query = make_query(lambda p: np.ones(len(p)), place=box.mean(axis=0), caller="clean")
    with pytest.warns(UserWarning, match="does it use its positions"):
        found = survey_field(
            query,
            box,
            1.0,
            (6, 4, 4),
            rule=RULE,
            faint=0.1,
            opaque_pitch=1.0,
            soft=True,
            keep_boxes=(),
            probe=2,
            drop_invalid=False,
            rows=99,
        )
    assert found.judged.sum() == 4 * 4 * 4


def test_clean_says_how_often_it_asked_and_decides_alike(kit):
    rng = np.random.default_rng(4)
    density = np.zeros((48, 40, 33), dtype=np.float32)
    density[2:6] = 40.0
    density.flat[rng.integers(0, density.size, 60)] = 40.0
    box = np.array([[0.0, 0.0, 0.0], density.shape]) / 10
    masks = [
        clean(
            grid_density_fn(density * 10, box),
            box,
            denoiser=kit.numpy_denoiser(kit.identity),
            field_pitch=0.1,
            probe=probe,
        )
        for probe in (1, 2)
    ]
    assert (masks[0].cells == masks[1].cells).all()
    assert not masks[0].cells.all()
    assert masks[1].details["asked"] < masks[0].details["asked"] == density.size
    assert masks[0].details["regions"] == masks[1].details["regions"]
    with pytest.raises(ValueError, match="clean: probe must be >= 1, got 0"):
        clean(lambda p: p[:, 0], box, denoiser=kit.numpy_denoiser(kit.identity), probe=0)
