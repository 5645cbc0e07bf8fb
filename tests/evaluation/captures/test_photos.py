"""Photos as people have them: other folders, other formats, other sizes, turned, and files that are no photos."""

import base64
import json
import sys
import zlib
from types import ModuleType

import numpy as np
import pytest
from PIL import Image

from unghost.evaluation.captures.frames import extract_frames
from unghost.evaluation.captures.loading import load_cameras, load_capture
from unghost.evaluation.captures.nerfstudio import write_nerfstudio

WIDTH, HEIGHT = 64, 48
LENS = {"fl_x": 60.0, "fl_y": 61.0, "cx": 31.0, "cy": 25.0, "w": WIDTH, "h": HEIGHT}
HEIC = (  # 64 x 48 pixels of (100, 150, 200), written with libheif, compressed
    "eNpjYGCQSSupLMhIzUxmAILczDRDEDs3MzGNgYGxNje1JJEBAhQzUnKKoGyGgszkEgY0oJSZkw82xMWBgREIgYBxIYQGAjkgVs7M"
    "zEsD80CiokBOKhOUl1GWbAhi8hVkluTClfzNLCgqANJ3MwuS84F0GVCZMyMzSGgCxNQPDH/+/vjBwMDPnADUIeHAyMP4/z9IATNI"
    "BTMIye1ickgESmo5MTKiySxQaGSd9urJsp07ODIMFIBCzCCCQTEJqJzNhfFg8YFOoCXCyfk5RXnJORVAUV4GtgagkEhmcUEq1GcO"
    "UKyRnJNYAGWDHG8ApUGA6f///x9ANBALFGRWZIIEmTk4OICURGZBLiyQgeHG2sjEzNoCZKvlpiSCAllKg3E95wNLZZV9+9/I/n3/"
    "eNv+/zNUV4dZzT1/AADEi1b3"
)


def pose(number):
    return [[1, 0, 0, number], [0, 1, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]]


def photo(path, number=0, size=(WIDTH, HEIGHT), **options):
    """Red as the number says, the upper left quarter green."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.zeros((size[1], size[0], 3), np.uint8)
    pixels[..., 0] = 20 * number
    pixels[: size[1] // 2, : size[0] // 2, 1] = 200
    Image.fromarray(pixels).save(path, **options)


def capture(folder, names, lens=LENS, **keys):
    """``transforms.json`` with a frame for each name."""
    folder.mkdir(parents=True, exist_ok=True)
    frames = [{"file_path": name, "transform_matrix": pose(number)} for number, name in enumerate(names)]
    (folder / "transforms.json").write_text(json.dumps({**lens, **keys, "frames": frames}))
    return folder


def plain(folder, **options):
    return load_capture(folder, downscale=1, normalize=False, **options)


@pytest.mark.parametrize("elsewhere", [False, True])
@pytest.mark.parametrize("ending", [".png", ".PNG", ".jpg"])
def test_the_lens_is_scaled_to_smaller_copies(tmp_path, elsewhere, ending):
    """13 x 10 of 50 x 39, as a resizer that rounds up makes them."""
    folder = capture(tmp_path / "c", ["images/a.png", "images/b.png"], {**LENS, "w": 50, "h": 39})
    photos = tmp_path / "small" if elsewhere else folder / "images_4"
    for number, name in enumerate("ab"):
        photo(photos / f"{name}{ending}", number, (13, 10))
        if not elsewhere:
            photo(folder / "images_8" / f"{name}{ending}", 9, (7, 5))  # the larger copies are taken
    found = plain(folder, photos=photos if elsewhere else None)
    assert (found.cameras.width, found.cameras.height) == (13, 10)
    wanted = [60 * 13 / 50, 61 * 10 / 39, 31 * 13 / 50, 25 * 10 / 39]
    np.testing.assert_allclose(found.cameras.intrinsics, [wanted] * 2)
    assert found.images([1])[0, -1, -1, 0] * 255 == pytest.approx(20, abs=5)
    write_nerfstudio(found, tmp_path / "out", train=[0], evaluation=[1])
    np.testing.assert_allclose(plain(tmp_path / "out").cameras.intrinsics, [wanted] * 2)


def test_the_folder_of_photos_may_be_named_from_the_capture(tmp_path):
    folder = capture(tmp_path / "c", ["images/a.png"])
    photo(folder / "images" / "a.png")
    photo(folder / "images_2" / "a.png", size=(32, 24))
    assert plain(folder, photos="images_2").cameras.width == 32
    with pytest.raises(FileNotFoundError, match=r"no folder images_9 with photos, neither here nor in .*c"):
        plain(folder, photos="images_9")


def test_photos_of_other_proportions_are_still_refused(tmp_path):
    folder = capture(tmp_path / "c", ["images/a.png"])
    photo(folder / "images_2" / "a.png", size=(32, 32))
    with pytest.raises(ValueError, match=r"photo images/a\.png is 32 x 32, transforms\.json says 64 x 48"):
        plain(folder)
    photo(folder / "images" / "a.png", size=(32, 24))  # smaller, and not in a folder that says so
    with pytest.raises(ValueError, match=r"32 x 24, transforms\.json says 64 x 48"):
        plain(folder)


@pytest.mark.parametrize(
    "start", ["E:\\mine\\room\\images\\", "/data/mine/room/images/", "../room/images/", "D:/elsewhere/"]
)
def test_paths_of_another_machine_lead_to_the_photos_here(tmp_path, start):
    folder = capture(tmp_path / "c", [f"{start}a.png", f"{start}b.png"])
    for number, name in enumerate("ab"):
        photo(folder / "images" / f"{name}.png", number)
    found = plain(folder)
    assert [path.relative_to(folder).as_posix() for path in found.paths] == ["images/a.png", "images/b.png"]
    assert [path.name for path in plain(folder, photos=folder / "images").paths] == ["a.png", "b.png"]


def test_two_paths_that_lead_to_one_photo_lead_to_none(tmp_path):
    folder = capture(tmp_path / "c", ["/x/left/a.png", "/x/right/a.png"])
    photo(folder / "images" / "a.png")
    with pytest.raises(FileNotFoundError, match="2 of the 2 photos"):
        plain(folder)
    photo(folder / "left" / "a.png")
    photo(folder / "right" / "a.png")
    assert [path.parent.name for path in plain(folder).paths] == ["left", "right"]


def test_a_plain_relative_path_is_not_guessed_at(tmp_path):
    folder = capture(tmp_path / "c", ["left/a.png"])
    photo(folder / "a.png")
    with pytest.raises(FileNotFoundError, match="1 of the 1 photos"):
        plain(folder)


def synthetic(folder):
    """Laid out as NeRF-synthetic is: three files, no sizes, no endings, transparent PNGs."""
    for sweep, numbers in (("train", range(4)), ("val", (4,)), ("test", (5, 6))):
        frames = []
        for place, number in enumerate(numbers):
            path = folder / sweep / f"r_{place}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            picture = Image.new("RGBA", (20, 10), (200, 30, 30, 0))
            picture.paste((200, 30, 30, 255), (10, 0, 20, 10))
            picture.save(path)
            frames.append({"file_path": f"./{sweep}/r_{place}", "rotation": 0.01, "transform_matrix": pose(number)})
        (folder / f"transforms_{sweep}.json").write_text(json.dumps({"camera_angle_x": 0.6911, "frames": frames}))
    return folder


def test_a_synthetic_nerf_scene_is_a_capture(tmp_path):
    folder = synthetic(tmp_path / "lego")
    found = plain(folder)
    assert {sweep: len(found.split(sweep)) for sweep in found.splits} == {"train": 4, "val": 1, "test": 2}
    np.testing.assert_array_equal(found.cameras.origins[found.split("test"), 0], [5, 6])
    np.testing.assert_allclose(found.cameras.intrinsics[:, 0], 10 / np.tan(0.6911 / 2))
    image = found.images([0])[0]
    np.testing.assert_array_equal(image[:, :10], 1.0)  # white
    np.testing.assert_allclose(image[:, 10:], np.broadcast_to([200 / 255, 30 / 255, 30 / 255], (10, 10, 3)))
    assert len(load_cameras(folder)) == 7
    cameras = load_cameras(folder / "transforms_train.json")
    assert (len(cameras), cameras.width, cameras.height) == (4, 20, 10)
    write_nerfstudio(found, tmp_path / "out", train=found.split("train"), evaluation=found.split("test"))
    meta = json.loads((tmp_path / "out" / "transforms.json").read_text())
    assert meta["fl_x"] == pytest.approx(10 / np.tan(0.6911 / 2))
    assert meta["frames"][0]["rotation"] == 0.01
    assert "camera_angle_x" not in meta["frames"][0]


def test_renders_are_scored_against_a_synthetic_nerf_scene(tmp_path, capsys):
    from unghost import cli

    folder = synthetic(tmp_path / "lego")
    for name in ("r_0", "r_1"):
        photo(tmp_path / "renders" / f"{name}.png", size=(20, 10))
    words = [tmp_path / "renders", "--gt", folder, "--out", tmp_path / "page"]
    assert cli.main(["evaluate", *map(str, words)]) == 0
    assert "1 method, 2 views" in capsys.readouterr().out


def test_one_photo_in_two_files_of_a_synthetic_scene_is_one_frame(tmp_path):
    folder = synthetic(tmp_path / "lego")
    shared = json.loads((folder / "transforms_test.json").read_text())
    (folder / "transforms_val.json").write_text(json.dumps(shared))
    found = plain(folder)
    assert len(found) == 6
    assert found.split("val").tolist() == found.split("test").tolist()
    shared["frames"][0]["transform_matrix"] = pose(9)
    (folder / "transforms_val.json").write_text(json.dumps(shared))
    with pytest.raises(ValueError, match=r"'test/r_0' stands in two files of .* with two poses"):
        plain(folder)


def turned(orientation):
    exif = Image.Exif()
    exif[0x0112] = orientation
    return {"exif": exif}


def test_an_exif_tag_counts_where_the_stated_size_is_the_turned_one(tmp_path):
    """Orientation 6: to be shown turned by 90 degrees clockwise, so the upper left quarter comes to the upper right."""
    folder = capture(tmp_path / "c", ["images/a.png"], {**LENS, "w": HEIGHT, "h": WIDTH})
    photo(folder / "images" / "a.png", **turned(6))
    found = plain(folder)
    assert found.photo_size(0) == (found.cameras.width, found.cameras.height) == (HEIGHT, WIDTH)
    green = found.images([0])[0, ..., 1] > 0.5
    assert green[: WIDTH // 2, HEIGHT // 2 :].all()
    assert green.mean() == pytest.approx(0.25)
    for photos in ("copy", "link"):
        write_nerfstudio(found, tmp_path / photos, train=[0], evaluation=[0], photos=photos)
        with Image.open(tmp_path / photos / "images" / "a.png") as written:  # as nerfstudio opens it
            assert written.size == (HEIGHT, WIDTH)
            assert written.getexif().get(0x0112, 1) == 1


def test_an_exif_tag_does_not_count_where_the_stated_size_is_the_stored_one(tmp_path):
    folder = capture(tmp_path / "c", ["images/a.png"])
    photo(folder / "images" / "a.png", **turned(6))
    green = plain(folder).images([0])[0, ..., 1] > 0.5
    assert green[: HEIGHT // 2, : WIDTH // 2].all()
    photo(folder / "images" / "a.png", **turned(3))  # upside down: the size does not tell
    with pytest.warns(UserWarning, match=r"EXIF tags of 1 photos turn them .* as COLMAP and nerfstudio read them"):
        upside = plain(folder)
    assert (upside.images([0])[0, : HEIGHT // 2, : WIDTH // 2, 1] > 0.5).all()


def test_a_byte_order_mark_is_understood_in_every_json(tmp_path):
    folder = capture(tmp_path / "c", ["images/a.png", "images/b.png"])
    for number, name in enumerate("ab"):
        photo(folder / "images" / f"{name}.png", number)
    text = (folder / "transforms.json").read_text()
    for encoding in ("utf-8-sig", "utf-16"):  # as Notepad and PowerShell write
        (folder / "transforms.json").write_bytes(text.encode(encoding))
        (folder / "splits.json").write_bytes(json.dumps({"one": ["a.png"]}).encode(encoding))
        assert plain(folder).split("one").tolist() == [0]
        assert len(load_cameras(folder)) == 2


@pytest.fixture
def heif(monkeypatch):
    """A stand-in for pi-heif: Pillow opens files by their content, so JPEGs called .heic do for the rest."""
    module = ModuleType("pi_heif")
    module.register_heif_opener = lambda: None
    monkeypatch.setitem(sys.modules, "pi_heif", module)


def test_heic_photos_are_taken_and_stored_as_jpeg(tmp_path, heif):
    pytest.importorskip("av")
    photo(tmp_path / "in" / "IMG_1.HEIC", 1, format="JPEG")
    photo(tmp_path / "in" / "IMG_2.jpg", 2)
    (tmp_path / "in" / "._IMG_2.jpg").write_bytes(b"\x00\x05\x16\x07")  # AppleDouble
    (tmp_path / "in" / ".hidden.png").write_bytes(b"")
    found = extract_frames(tmp_path / "in", tmp_path / "out", prefix="f", count=9)
    assert found.sources == ("IMG_1.HEIC", "IMG_2.jpg")
    assert [path.name for path in found.paths] == ["f00001.jpg", "f00002.jpg"]
    with Image.open(found.paths[0]) as written:
        assert written.format == "JPEG"
    folder = capture(tmp_path / "c", ["images/a.heic"])
    photo(folder / "images" / "a.heic", format="JPEG")
    write_nerfstudio(plain(folder), tmp_path / "ns", train=[0], evaluation=[0], photos="link")
    assert plain(tmp_path / "ns").names == ("images/a.jpg",)
    assert not (tmp_path / "ns" / "images" / "a.jpg").is_symlink()


def test_heic_photos_are_counted_where_they_cannot_be_read(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pi_heif", None)
    for name in ("a.heic", "b.HEIF", "c.jpg"):
        photo(tmp_path / "in" / name, format="JPEG")
    with pytest.raises(ImportError, match=r"2 HEIC photos \(a\.heic, …\) need pi-heif: pip install unghost\[capture"):
        extract_frames(tmp_path / "in", tmp_path / "out", prefix="f", count=9)
    folder = capture(tmp_path / "c", ["images/a.heic"])
    photo(folder / "images" / "a.heic", format="JPEG")
    with pytest.raises(ImportError, match=r"1 HEIC photos \(a\.heic\) need pi-heif"):
        plain(folder)


def test_real_heic_photos_are_read(tmp_path):
    pytest.importorskip("pi_heif")
    folder = capture(tmp_path / "c", ["images/a.heic"])
    (folder / "images").mkdir()
    (folder / "images" / "a.heic").write_bytes(zlib.decompress(base64.b64decode(HEIC)))
    images = plain(folder).images([0])
    assert images.shape == (1, HEIGHT, WIDTH, 3)
    np.testing.assert_allclose(images[0].mean(axis=(0, 1)) * 255, [100, 150, 200], atol=3)


def test_pictures_in_formats_that_are_not_read_are_counted(tmp_path):
    photo(tmp_path / "in" / "a.png")
    for name in ("b.DNG", "c.dng", "d.cr2", "notes.txt"):
        (tmp_path / "in" / name).write_bytes(b"raw")
    with pytest.warns(UserWarning, match=r"are left out: 1 \.cr2, 2 \.dng"):
        found = extract_frames(tmp_path / "in", tmp_path / "out", prefix="f", count=9)
    assert found.sources == ("a.png",)
