import gzip
import sys

import numpy as np
import pytest
from PIL import Image

from unghost.evaluation.scoring import renders as renders_folder
from unghost.evaluation.scoring.renders import match_names, read_masks, read_method, read_photos

HEIGHT, WIDTH = 6, 8
SHAPE = (HEIGHT, WIDTH)
VIEWS = ("images/a.jpg", "images/b.jpg")


def picture(path, value, *, mode="RGB", size=(WIDTH, HEIGHT)):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new(mode, size, value).save(path)


@pytest.fixture
def renders(tmp_path):
    picture(tmp_path / "a.png", (51, 102, 255))
    picture(tmp_path / "b.png", (0, 0, 0))
    return tmp_path


def test_colours_are_matched_by_file_name_and_read_exactly(renders):
    found = read_method("ours", renders, VIEWS[::-1], SHAPE)
    assert found.renders.colours.shape == (2, HEIGHT, WIDTH, 3)
    assert found.renders.colours.dtype == np.float32
    np.testing.assert_allclose(found.renders.colours[1, 0, 0], [0.2, 0.4, 1.0], atol=1e-7)
    assert found.renders.colours[0].max() == 0
    assert found.name == "ours"
    assert found.confidence is found.renders.depth is None


def test_the_path_counts_before_the_name(tmp_path):
    for folder, value in (("left", 10), ("right", 20)):
        picture(tmp_path / folder / "0.png", (value, value, value))
    found = read_method("m", tmp_path, ("right/0.png", "left/0.jpg"), SHAPE)
    assert (found.renders.colours[:, 0, 0, 0] * 255).round().tolist() == [20, 10]
    with pytest.raises(ValueError, match=r"2 of 2 views have none \(x/0.png, y/0.png\); 2 belong to no view"):
        read_method("m", tmp_path, ("x/0.png", "y/0.png"), SHAPE)


@pytest.mark.parametrize("per_view", [True, False])
def test_maps_beside_the_colours(renders, per_view):
    rng = np.random.default_rng(0)
    maps = {
        "depth": rng.uniform(1, 2, (2, *SHAPE)),
        "accumulation": rng.random((2, *SHAPE)),
        "normals": np.tile([0.0, 0, 1], (2, *SHAPE, 1)),
        "uncertainty": rng.random((2, *SHAPE)),
    }
    if per_view:
        for key, values in maps.items():
            (renders / key).mkdir()
            for name, each in zip("ab", values):
                np.save(renders / key / f"{name}.npy", each)
        Image.new("L", (3, 3)).save(renders / "depth" / "a.png")  # for people: not a render
    else:
        np.savez(renders / "maps.npz", names=np.array(["b", "a"]), **{key: each[::-1] for key, each in maps.items()})
    found = read_method("m", renders, VIEWS, SHAPE)
    np.testing.assert_array_equal(found.renders.depth, maps["depth"])
    np.testing.assert_array_equal(found.renders.accumulation, maps["accumulation"])
    np.testing.assert_array_equal(found.renders.normals, maps["normals"])
    np.testing.assert_array_equal(found.confidence, -maps["uncertainty"])


def test_confidence_is_uncertainty_the_other_way_round_and_only_one_of_them(renders):
    values = np.random.default_rng(0).random((2, *SHAPE))
    np.savez(renders / "maps.npz", names=np.array(["a", "b"]), confidence=values)
    np.testing.assert_array_equal(read_method("m", renders, VIEWS, SHAPE).confidence, values)
    np.savez(renders / "maps.npz", names=np.array(["a", "b"]), confidence=values, uncertainty=values)
    with pytest.raises(ValueError, match="has both confidence and uncertainty"):
        read_method("m", renders, VIEWS, SHAPE)


def test_nan_depth_is_counted_and_its_folder_named(renders):
    depth = np.ones((2, *SHAPE))
    depth[0, 0, :3], depth[1, 1, 1] = np.nan, 0
    np.savez(renders / "maps.npz", names=np.array(["a", "b"]), depth=depth)
    with pytest.raises(ValueError, match=r"depth must be > 0 .*, 4 values are not \(3 NaN\) \(in .*\)"):
        read_method("m", renders, VIEWS, SHAPE)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"depth": np.ones((2, *SHAPE))}, "must hold names"),
        ({"names": np.array(["a"]), "depth": np.ones((2, *SHAPE))}, "one text for each of the 2 maps of depth"),
        ({"names": np.array(["a", "c"]), "depth": np.ones((2, *SHAPE))}, r"depth maps in .* 1 of 2 views have none"),
        ({"names": np.array(["a", "b"]), "depth": np.ones((2, 3, 3))}, r"shape \(6, 8\) a view, got float64 \(3, 3\)"),
        ({"names": np.array(["a", "b"]), "depth": np.ones((2, *SHAPE), int)}, "must be floating point"),
        ({"names": np.array(["a", "b"]), "z": np.ones((2, *SHAPE))}, "holds z; it may hold names, depth"),
    ],
)
def test_maps_that_do_not_fit(renders, arrays, message):
    np.savez(renders / "maps.npz", **arrays)
    with pytest.raises(ValueError, match=message):
        read_method("m", renders, VIEWS, SHAPE)


def test_pickles_and_other_files_are_refused(renders):
    np.save(renders / "maps.npy", np.array([{}], dtype=object), allow_pickle=True)
    (renders / "maps.npy").rename(renders / "maps.npz")
    with pytest.raises(ValueError, match=r"maps\.npz is no \.npy or \.npz of numbers"):
        read_method("m", renders, VIEWS, SHAPE)


def test_all_mismatches_are_reported_together(renders):
    for name in ("x1", "x2", "x3", "x4"):
        picture(renders / f"{name}.png", (0, 0, 0))
    views = [*VIEWS, "images/c.jpg"]
    message = r"1 of 3 views have none \(images/c.jpg\); 4 belong to no view \(x1, x2, x3, …\)"
    with pytest.raises(ValueError, match=message):
        read_method("m", renders, views, SHAPE)


def test_another_size_is_said_with_a_way_out(renders):
    with pytest.raises(
        ValueError,
        match=r"2 of 2 pictures .* are not 16 x 12 as the photos are: a.png is 8 x 6, b.png "
        r"is 8 x 6; the photos are 2 times as wide \(see downscale\)",
    ):
        read_method("m", renders, VIEWS, (12, 16))


@pytest.mark.parametrize(
    ("mode", "value", "message"),
    [("RGBA", (1, 2, 3, 9), "has transparent pixels"), ("I;16", 700, "pixels of kind I;16, not 8-bit")],
)
def test_pixels_that_are_no_plain_colours(renders, mode, value, message):
    picture(renders / "a.png", value, mode=mode)
    with pytest.raises(ValueError, match=message):
        read_method("m", renders, VIEWS, SHAPE)


def test_grey_and_opaque_pictures_are_fine(renders):
    picture(renders / "a.png", 51, mode="L")
    picture(renders / "b.png", (51, 51, 51, 255), mode="RGBA")
    np.testing.assert_allclose(read_method("m", renders, VIEWS, SHAPE).renders.colours, 0.2, atol=1e-7)


def test_broken_pictures_and_folders(renders, tmp_path):
    (renders / "a.png").write_bytes((renders / "a.png").read_bytes()[:40])
    with pytest.raises(ValueError, match=r"cannot (read|decode) .*a\.png"):
        read_method("m", renders, VIEWS, SHAPE)
    with pytest.raises(FileNotFoundError, match="no folder"):
        read_photos(tmp_path / "absent")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="holds no pictures"):
        read_photos(tmp_path / "empty")
    picture(tmp_path / "twice" / "a.png", (0, 0, 0))
    picture(tmp_path / "twice" / "a.jpg", (0, 0, 0))
    with pytest.raises(ValueError, match="has a twice"):
        read_photos(tmp_path / "twice")


def test_photos_are_shrunk_by_the_mean_of_their_pixels(tmp_path):
    pixels = np.zeros((4, 6, 3), dtype=np.uint8)
    pixels[:2, :2] = [[200] * 3, [100] * 3]
    Image.fromarray(pixels).save(tmp_path / "p.png")
    names, photos = read_photos(tmp_path, downscale=2)
    assert names == ("p",)
    assert photos.shape == (1, 2, 3, 3)
    assert photos[0, 0, 0, 0] * 255 == pytest.approx(150, abs=0.5)
    picture(tmp_path / "q.png", (0, 0, 0))
    with pytest.raises(ValueError, match="one size, got 6 x 4, 8 x 6"):
        read_photos(tmp_path)
    with pytest.raises(ValueError, match=r"downscale must be >= 1, got 0\.5"):
        read_photos(tmp_path, downscale=0.5)
    assert read_photos(tmp_path, ("x/p.jpg",))[1].shape == (1, 4, 6, 3)  # more photos than views


def test_what_nerfstudio_renders_is_found(tmp_path):
    depth = np.random.default_rng(0).uniform(1, 2, (2, *SHAPE, 1)).astype(np.float32)
    for name, value, each in zip("ab", (51, 102), depth):
        picture(tmp_path / "rgb" / f"{name}.jpg", (value,) * 3)
        picture(tmp_path / "gt-rgb" / f"{name}.jpg", (9, 9, 9))
        (tmp_path / "raw-depth").mkdir(exist_ok=True)
        with gzip.open(tmp_path / "raw-depth" / f"{name}.npy.gz", "wb") as stream:
            np.save(stream, each)
    found = read_method("nerfacto", tmp_path, VIEWS, SHAPE).renders
    np.testing.assert_array_equal(found.depth, depth[..., 0])
    assert (found.colours[:, 0, 0, 0] * 255).round().tolist() == pytest.approx([51, 102], abs=1)
    whole = (tmp_path / "raw-depth" / "a.npy.gz").read_bytes()
    for broken in (whole[:-30], b"no gzip", whole[:12] + b"x" * 40):
        (tmp_path / "raw-depth" / "a.npy.gz").write_bytes(broken)
        with pytest.raises(ValueError, match=r"a\.npy\.gz is no \.npy or \.npz of numbers"):
            read_method("nerfacto", tmp_path, VIEWS, SHAPE)


def test_two_masks_of_one_view_are_refused(tmp_path):
    for name in ("images_a", "depth_a", "b"):
        picture(tmp_path / f"{name}.png.mask.png", 255, mode="L")
    with pytest.raises(ValueError, match=r"two masks of a: depth_a\.png\.mask\.png and images_a"):
        read_masks(tmp_path, ("a.png", "b.png"), SHAPE)
    (tmp_path / "depth_a.png.mask.png").unlink()
    assert read_masks(tmp_path, ("a.png", "b.png"), SHAPE).all()


def test_masks_as_the_verb_names_them(tmp_path):
    picture(tmp_path / "images_a.jpg.mask.png", 255, mode="L")
    picture(tmp_path / "b.png", 100, mode="L")
    found = read_masks(tmp_path, VIEWS, SHAPE)
    assert found.dtype == np.bool_
    assert found[0].all()
    assert not found[1].any()


def test_match_names_by_hand():
    assert match_names("t", ["a", "b"], ["b", "a"], where="w") == ("b", "a")
    assert match_names("t", ["d/a.1", "d/b.1"], ["x/b.1.png", "x/a.1.png"], where="w") == ("d/b.1", "d/a.1")
    assert match_names("t", ["a", "b", "c"], ["a"], where="w", whole=False) == ("a",)
    with pytest.raises(ValueError, match="t in w do not match the views: 1 belong to no view"):
        match_names("t", ["a", "b"], ["a"], where="w")


def test_without_pillow_the_extra_is_named(renders, monkeypatch):
    monkeypatch.setitem(sys.modules, "PIL", None)
    with pytest.raises(ImportError, match=r"pip install unghost\[eval\]"):
        read_photos(renders)
    assert renders_folder.PICTURES


def test_dot_files_are_no_pictures(renders):
    (renders / "._a.png").write_bytes(b"\x00\x05\x16\x07")  # AppleDouble
    assert read_photos(renders)[0] == ("a", "b")
    assert len(read_method("ours", renders, VIEWS, SHAPE).renders.colours) == 2


def test_transparent_photos_stand_before_white_and_transparent_renders_are_refused(renders):
    picture(renders / "a.png", (255, 0, 51, 102), mode="RGBA")  # 0.4 opaque
    np.testing.assert_allclose(read_photos(renders)[1][0, 0, 0], [1.0, 0.6, 0.68], atol=1 / 255)
    with pytest.raises(ValueError, match=r"a\.png has transparent pixels"):
        read_method("ours", renders, VIEWS, SHAPE)


def test_photos_that_exif_turns_are_read_as_stored_with_a_warning(renders):
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.new("RGB", (WIDTH, HEIGHT)).save(renders / "a.png", exif=exif)
    with pytest.warns(UserWarning, match=r"EXIF tags of 1 photos in .* read as they are stored"):
        _, photos = read_photos(renders)
    assert photos.shape == (2, HEIGHT, WIDTH, 3)


def test_photos_in_further_formats_are_read_and_others_are_counted(tmp_path):
    for ending in ("tif", "webp", "bmp"):
        picture(tmp_path / f"{ending}.{ending}", (9, 9, 9))
    (tmp_path / "raw.dng").write_bytes(b"raw")
    with pytest.warns(UserWarning, match=r"left out: 1 \.dng"):
        assert read_photos(tmp_path)[0] == ("bmp", "tif", "webp")
