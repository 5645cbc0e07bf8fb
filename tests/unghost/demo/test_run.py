import base64
import json
import re

import numpy as np
import pytest
from unghost_tests.pages import read_page

from unghost.core.manifest import Manifest
from unghost.demo import pictures as demo_pictures
from unghost.demo import run as demo
from unghost.denoisers import WEIGHTS
from unghost.scenes.labelled_room.ghosts import COUNTS, KINDS
from unghost.scenes.labelled_room.room import AABB, FAR, SHAPE, build_room
from unghost.scenes.volume_renderer import PAPER, Volume, camera_at, render


class Threshold:
    """A crude denoiser: what is nearly opaque stays."""

    kind, manifest = "numpy", Manifest("threshold")

    def __call__(self, channels, timestep, edge_fraction):
        return np.where(channels[:, :1] > 0.5, 1.0, -1.0).astype(np.float32)


@pytest.fixture(scope="module")
def room():
    return build_room(0)


@pytest.mark.slow
def test_the_room_depends_on_the_seed_alone(room):
    again, other = build_room(0), build_room(1)
    np.testing.assert_array_equal(room.density, again.density)
    np.testing.assert_array_equal(room.ghost_kind, again.ghost_kind)
    assert (room.density != other.density).mean() > 0.01
    with pytest.raises(ValueError, match="seed must be >= 0, got -1"):
        build_room(-1)


@pytest.mark.slow
def test_the_density_is_a_fields(room):
    assert room.density.shape == room.ghost_kind.shape == SHAPE
    assert room.density.dtype == np.float32
    assert np.isfinite(room.density).all()
    assert (room.density >= room.true_density).all()
    assert (room.true_density >= 0).all()
    occupied = room.surface(demo.RULE)
    depth = np.abs(room.distance[occupied]) / room.pitch
    assert depth.max() < 3.0  # a skin: nothing far from a surface is occupied
    assert np.median(1 - np.exp(-room.true_density[np.abs(room.distance + 0.5 * room.pitch) < 0.01] * room.pitch)) > 0.7


def test_the_distance_is_right_where_it_is_known_by_hand(room):
    assert room.distance.max() == pytest.approx(FAR)
    x = AABB[0, 0] + 2.5 * room.pitch  # -2.46: six centimetres inside the wall at -2.4
    assert room.distance[2, 60, 60] == pytest.approx(x + 2.4, abs=1e-5)
    z = AABB[0, 2] + 10.5 * room.pitch  # .26 above the floor, far from the furniture
    assert room.distance[5, 5, 10] == pytest.approx(min(z, AABB[0, 0] + 5.5 * room.pitch + 2.4), abs=1e-5)


def test_every_kind_of_ghost_is_there_and_in_free_space(room):
    ghosts = room.occupied(demo.RULE) & ~room.surface(demo.RULE)
    for index, kind in enumerate(KINDS):
        assert (ghosts & (room.ghost_kind == index)).sum() > 20 * COUNTS[kind], kind
    assert (ghosts & (room.ghost_kind < 0)).mean() < 1e-3
    assert (room.distance[ghosts] > -room.pitch).all()  # none inside solids
    detached = ghosts & (room.ghost_kind == KINDS.index("detached"))
    assert np.median(room.distance[detached]) > 2 * room.pitch


def test_scores_at_the_extremes(room):
    surface, occupied = room.surface(demo.RULE), room.occupied(demo.RULE)
    perfect = demo.score(room, surface)
    assert perfect["floater_recall"] == perfect["floater_precision"] == perfect["surface_kept"] == perfect["iou"] == 1.0
    assert set(perfect["recall_by_kind"].values()) == {1.0}
    idle = demo.score(room, np.ones(SHAPE, dtype=bool))
    assert (idle["floater_recall"], idle["surface_kept"]) == (0.0, 1.0)
    assert idle["floater_precision"] is None  # nothing was removed
    assert idle["iou"] == idle["iou_before"] == pytest.approx(surface.sum() / occupied.sum())
    nothing = demo.score(room, np.zeros(SHAPE, dtype=bool))
    assert (nothing["floater_recall"], nothing["surface_kept"], nothing["iou"]) == (1.0, 0.0, 0.0)
    with pytest.raises(ValueError, match="score: kept must be bool"):
        demo.score(room, np.zeros(3, dtype=bool))


def test_scores_by_hand(room):
    """Keep everything but half of the ghosts and a tenth of the surface, and count with numpy alone."""
    rng = np.random.default_rng(0)
    surface, occupied = room.surface(demo.RULE), room.occupied(demo.RULE)
    ghosts = occupied & ~surface
    kept = np.where(surface, rng.random(SHAPE) > 0.1, rng.random(SHAPE) > 0.5)
    found = demo.score(room, kept)
    removed = (occupied & ~kept).sum()
    assert found["floater_recall"] == pytest.approx((ghosts & ~kept).sum() / ghosts.sum())
    assert found["floater_precision"] == pytest.approx((ghosts & ~kept).sum() / removed)
    assert found["surface_kept"] == pytest.approx((surface & kept).sum() / surface.sum())
    assert found["iou"] == pytest.approx((surface & kept).sum() / (surface | (occupied & kept)).sum())


def test_the_largest_component_is_what_scipy_says(room):
    kept = demo._run_components(room, None)
    scores = demo.score(room, kept)
    assert scores["floater_precision"] == 1.0
    assert scores["recall_by_kind"]["touching"] < 0.1 < scores["recall_by_kind"]["detached"]


@pytest.mark.slow
def test_a_whole_run(tmp_path, monkeypatch):
    small = camera_at((6.0, -6.0, 4.9), (-0.1, 0.1, 0.72), width=96, height=72, fov_degrees=40.0)
    monkeypatch.setattr(demo_pictures, "CAMERA", small)
    results = demo.run_demo(tmp_path / "out", denoiser=Threshold())
    written = json.loads((tmp_path / "out" / "result.json").read_text(encoding="utf-8"))
    assert written == results
    assert [row["method"] for row in written["rows"]] == ["clean", "components"]
    keys = {"floater_recall", "floater_precision", "surface_kept", "iou_before", "iou", "seconds"}
    assert keys <= set(written["rows"][0])
    assert written["seeds"] == [0]
    assert written["rows"][0]["floater_recall"] > 0.5
    page = (tmp_path / "out" / "index.html").read_text(encoding="utf-8")
    pictures = re.findall(r"data:image/png;base64,([A-Za-z0-9+/=]+)", page)
    assert len(pictures) == 6
    assert all(base64.b64decode(png).startswith(b"\x89PNG") for png in pictures)
    assert read_page(page).count("script") == 1  # the slider's
    assert not list((tmp_path / "out").glob("*.partial"))
    table = demo.summary_table(results)
    assert "clean" in table
    assert "touching" in table


def test_the_renderer_by_hand():
    """An opaque green slab fills the picture where it stands, paper shows where it does not."""
    samples = np.zeros((8, 8, 8, 4), dtype=np.float32)
    samples[:, :, :4] = (0.1, 0.8, 0.2, 9.0)
    box = np.array([[-1.0, -1, -1], [1, 1, 1]])
    camera = camera_at((0.0, -6.0, 0.0), (0.0, 0.0, 0.0), width=21, height=21, fov_degrees=30.0)
    image = render(Volume(samples, box, 0.25), camera)
    assert image.shape == (21, 21, 3)
    np.testing.assert_allclose(image[0, 0], PAPER)
    np.testing.assert_allclose(image[14, 10], (0.1, 0.8, 0.2), atol=0.02)
    np.testing.assert_allclose(image[6, 10], PAPER, atol=0.02)


@pytest.mark.slow
@pytest.mark.skipif(not (WEIGHTS / "default.onnx").is_file(), reason="no weights in this checkout yet")
def test_the_shipped_prior_reaches_the_goal(room):
    from unghost import load_denoiser

    scores = demo.score(room, demo._run_clean(room, load_denoiser()))
    assert scores["floater_recall"] >= 0.9
    assert scores["surface_kept"] >= 0.98
