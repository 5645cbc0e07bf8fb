"""Frames of videos encoded with the library that reads them; which ones are kept, and that they stand upright."""

import sys

import numpy as np
import pytest
from PIL import Image

from unghost.evaluation.captures.frames import extract_frames, sharpness

av = pytest.importorskip("av")

HEIGHT, WIDTH = 48, 64


def pattern(number, blurred=False):
    """A checkerboard, its upper left corner red; ``number`` in its brightness; flat where blurred."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] // 6
    board = np.where((rows + columns) % 2, 60, 60 if blurred else 180) + number
    picture = np.repeat(board[..., None], 3, axis=2).astype(np.uint8)
    picture[:12, :12] = (255, 0, 0)
    return picture


def encode(path, frames, *, rotation=None):
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=10)
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt, stream.bit_rate = "yuv420p", 4_000_000
        if rotation is not None:
            if not hasattr(stream, "set_display_rotation"):
                pytest.skip("this PyAV cannot write a rotation (Python 3.10)")
            stream.set_display_rotation(rotation)
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())
    return path


def test_sharpness_by_hand_and_its_order():
    flat = np.full((5, 6), 7)
    assert sharpness(flat) == 0
    dot = np.zeros((5, 5))
    dot[2, 2] = 1  # Laplacian of the inner 3 x 3: -4 in the middle, 1 at four places, 0 at four; mean 0
    assert sharpness(dot) == pytest.approx((16 + 4) / 9)
    assert sharpness(pattern(0)[..., 1]) > 5 * sharpness(pattern(0, blurred=True)[..., 1])
    with pytest.raises(ValueError, match=r"shape \(H, W\)"):
        sharpness(np.zeros((2, 9)))


def test_the_sharpest_frame_of_each_stretch_is_kept(tmp_path):
    sharp = (3, 9, 10, 19)  # of stretches 0..4, 5..9, 10..14, 15..19
    video = encode(tmp_path / "v.mp4", [pattern(2 * k, blurred=k not in sharp) for k in range(20)])
    found = extract_frames(video, tmp_path / "out", prefix="frame_", count=4)
    assert found.sources == sharp
    assert (found.seen, found.size) == (20, (WIDTH, HEIGHT))
    assert [path.name for path in found.paths] == [f"frame_0000{k}.jpg" for k in (1, 2, 3, 4)]
    assert sorted((tmp_path / "out").iterdir()) == list(found.paths)
    for number, path in zip(sharp, found.paths):
        with Image.open(path) as photo:
            np.testing.assert_allclose(np.asarray(photo)[14:17, 38:40], 180 + 2 * number, atol=8)  # inside a square


def test_of_a_short_video_every_frame_is_kept(tmp_path):
    found = extract_frames(encode(tmp_path / "v.mp4", [pattern(k) for k in range(3)]), tmp_path, prefix="f", count=9)
    assert found.sources == (0, 1, 2)


@pytest.mark.parametrize(("rotation", "corner"), [(None, (0, 0)), (90, (-1, 0)), (-90, (0, -1)), (180, (-1, -1))])
def test_videos_stand_upright(tmp_path, rotation, corner):
    """Turned counter-clockwise by 90, what was the upper left corner is the lower left one."""
    video = encode(tmp_path / "v.mp4", [pattern(0)] * 3, rotation=rotation)
    (path,) = extract_frames(video, tmp_path, prefix="f", count=1).paths
    with Image.open(path) as photo:
        assert photo.size == ((HEIGHT, WIDTH) if rotation in (90, -90) else (WIDTH, HEIGHT))
        pixels = np.asarray(photo)[:: -1 if corner[0] else 1, :: -1 if corner[1] else 1]
    assert pixels[2:9, 2:9, 0].min() > 200 > 80 > pixels[2:9, 2:9, 1].max()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "cannot read"),
        (b"this is no video" * 50, "cannot read"),
        (None, "cannot read"),  # the first half of an .mp4, whose index comes last
    ],
)
def test_what_is_no_video_is_refused(tmp_path, content, message):
    whole = encode(tmp_path / "v.mp4", [pattern(k) for k in range(5)]).read_bytes()
    (tmp_path / "bad.mp4").write_bytes(whole[: len(whole) // 2] if content is None else content)
    with pytest.raises(ValueError, match=rf"extract_frames: {message} .*bad\.mp4 as a video"):
        extract_frames(tmp_path / "bad.mp4", tmp_path, prefix="f", count=3)


def test_sound_alone_is_refused(tmp_path):
    with av.open(str(tmp_path / "a.wav"), "w") as container:
        stream = container.add_stream("pcm_s16le", rate=8000)
        samples = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), format="s16", layout="mono")
        samples.sample_rate = 8000
        container.mux(stream.encode(samples))
    with pytest.raises(ValueError, match=r"a\.wav has no video in it"):
        extract_frames(tmp_path / "a.wav", tmp_path, prefix="f", count=3)


def _photos(folder, names, **options):
    folder.mkdir()
    for number, name in enumerate(names):
        Image.fromarray(pattern(number)).save(folder / name, **options)
    return folder


def test_a_small_folder_is_copied_as_it_is_in_natural_order(tmp_path):
    folder = _photos(tmp_path / "in", ["p10.png", "p9.png", "p1.JPG"])
    (folder / "notes.txt").write_text("no photo")
    found = extract_frames(folder, tmp_path / "out", prefix="frame_1_", count=5)
    assert found.sources == ("p1.JPG", "p9.png", "p10.png")
    assert [path.name for path in found.paths] == ["frame_1_00001.jpg", "frame_1_00002.png", "frame_1_00003.png"]
    assert all(path.read_bytes() == (folder / name).read_bytes() for path, name in zip(found.paths, found.sources))


def test_of_a_large_folder_the_sharpest_are_kept(tmp_path):
    folder = tmp_path / "in"
    folder.mkdir()
    for number in range(7):
        Image.fromarray(pattern(0, blurred=number not in (2, 3, 6))).save(folder / f"{number}.png")
    found = extract_frames(folder, tmp_path / "out", prefix="f", count=3)  # 0..2, 3..4, 5..6
    assert (found.sources, found.seen) == (("2.png", "3.png", "6.png"), 7)


@pytest.mark.parametrize("orientation", [3, 6, 8])
def test_photos_that_are_to_be_shown_turned_are_stored_upright(tmp_path, orientation):
    from PIL import ImageOps

    exif = Image.Exif()
    exif[0x0112], exif[0x010F] = orientation, "maker"
    folder = _photos(tmp_path / "in", ["a.jpg"], exif=exif)
    (path,) = extract_frames(folder, tmp_path / "out", prefix="f", count=1).paths
    with Image.open(path) as photo, Image.open(folder / "a.jpg") as original:
        assert photo.getexif().get(0x0112, 1) == 1
        assert photo.getexif()[0x010F] == "maker"  # COLMAP guesses the focal length from such
        shown = np.asarray(ImageOps.exif_transpose(original)).astype(int)
        assert np.abs(np.asarray(photo) - shown).mean() < 2


def test_folders_that_will_not_do_are_refused(tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match=r"no photos in .*empty \(looked for \.jpg"):
        extract_frames(tmp_path / "empty", tmp_path / "o", prefix="f", count=3)
    with pytest.raises(FileNotFoundError, match=r"no video or folder .*gone"):
        extract_frames(tmp_path / "gone", tmp_path / "o", prefix="f", count=3)
    with pytest.raises(ValueError, match="count must be >= 1, got 0"):
        extract_frames(tmp_path / "empty", tmp_path / "o", prefix="f", count=0)
    folder = _photos(tmp_path / "in", ["a.png", "b.png"])
    Image.new("RGB", (32, 32)).save(folder / "c.png")
    with pytest.raises(ValueError, match="one size, got 2 of 64 x 48, 1 of 32 x 32"):
        extract_frames(folder, tmp_path / "o", prefix="f", count=3)
    (folder / "c.png").write_bytes(b"no photo")
    with pytest.raises(ValueError, match=r"cannot read a photo of .*c\.png"):
        extract_frames(folder, tmp_path / "o", prefix="f", count=3)


def test_without_the_library_the_extra_is_named(tmp_path, monkeypatch):
    video = encode(tmp_path / "v.mp4", [pattern(0)])
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(ImportError, match=r"needs av: pip install unghost\[capture\]"):
        extract_frames(video, tmp_path, prefix="f", count=3)
