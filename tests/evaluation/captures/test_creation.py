"""Making a capture when something breaks on the way: what was computed is there for the same call."""

import sys
from types import ModuleType

import numpy as np
import pytest
from PIL import Image

from unghost.evaluation.captures import creation, posing
from unghost.evaluation.captures.creation import make_capture
from unghost.evaluation.captures.loading import load_capture
from unghost.evaluation.captures.posing import NotJoinedError, PosingSettings

pycolmap = pytest.importorskip("pycolmap")


@pytest.fixture
def sweeps(tmp_path):
    for sweep in ("walk", "back"):
        (tmp_path / sweep).mkdir()
        for number in range(3):
            Image.fromarray(np.full((48, 64, 3), 40 * number, np.uint8)).save(tmp_path / sweep / f"{number}.png")
    return tmp_path / "walk", tmp_path / "back"


class _Colmap:
    """Stands in for the costly steps of COLMAP: counts them, and fails in one if told to."""

    def __init__(self, monkeypatch):
        self.calls, self.broken, self.posed = [], None, 6
        for step in ("_extract", "match_pairs", "_map"):
            monkeypatch.setattr(posing, step, self._step(step))

    def _step(self, step):
        def run(colmap, database, *arguments, **_):
            if step == self.broken:
                raise RuntimeError("the machine went down")
            self.calls.append(step)
            database.touch()
            if step == "_map":
                return [self._model(arguments[1])]
            return None

        return run

    def _model(self, folder):
        model = pycolmap.Reconstruction()
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(camera_id=1, model="PINHOLE", width=64, height=48, params=np.array([60.0, 60, 32, 24]))
        )
        names = [f"frame_{part}0000{k}.png" for part in ("", "1_") for k in (1, 2, 3)][: self.posed]
        for number, name in enumerate(names, start=1):
            pose = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.0, 0.1 * number, 0])), np.array([0.1, 0, 4.0]))
            model.add_image_with_trivial_frame(pycolmap.Image(name=name, camera_id=1, image_id=number), pose)
        (folder / "0").mkdir(parents=True)
        model.write_binary(folder / "0")
        return model


def test_after_a_crash_the_same_call_goes_on(sweeps, tmp_path, monkeypatch):
    colmap, out = _Colmap(monkeypatch), tmp_path / "out"
    colmap.broken = "_map"
    with pytest.raises(RuntimeError, match="went down"):
        make_capture(*sweeps, out)
    assert not out.exists()
    (work,) = tmp_path.glob("out.*.work")
    colmap.broken = None
    with monkeypatch.context() as patch:  # after the poses
        patch.setattr(creation, "write_splits", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            make_capture(*sweeps, out)
    assert work.is_dir()
    with monkeypatch.context() as patch:  # photos are not extracted again either
        patch.setattr(creation, "extract_frames", None)
        told = make_capture(*sweeps, out)
    assert colmap.calls == [
        "_extract",
        "match_pairs",
        "match_pairs",
        "_map",
        "match_pairs",
    ]  # what is matched is skipped inside
    assert not work.exists()
    assert told["versions"]["pycolmap"] == pycolmap.__version__
    assert len(load_capture(out).split("train")) == len(load_capture(out).split("eval")) == 3


def test_other_arguments_begin_anew_and_pairs_go_on_where_they_were(sweeps, tmp_path, monkeypatch):
    colmap, out = _Colmap(monkeypatch), tmp_path / "out"
    colmap.broken = "_map"
    for options in ({}, {"frames": 2}, {"settings": PosingSettings(seed=1)}, {"settings": PosingSettings(threads=1)}):
        with pytest.raises(RuntimeError):
            make_capture(*sweeps, out, **options)
    assert colmap.calls.count("_extract") == 3  # threads change nothing
    assert len(list(tmp_path.glob("out.*.work"))) == 3


def test_a_smaller_share_goes_on_from_what_was_posed(sweeps, tmp_path, monkeypatch):
    colmap, out = _Colmap(monkeypatch), tmp_path / "out"
    colmap.posed = 4  # one of the second sweep
    with pytest.raises(
        NotJoinedError, match=r"train 3 of 3, eval 1 of 3.*kept in .*\.work: the same call with a small"
    ):
        make_capture(*sweeps, out)
    told = make_capture(*sweeps, out, settings=PosingSettings(minimum_share=0.3))
    assert colmap.calls.count("_map") == 1
    assert told["eval"]["posed"] == 1


def test_matching_goes_on_after_the_pairs_that_are_done(tmp_path):
    state = posing._State(tmp_path)
    state.save(features=True, pairs=4)
    state, matched = posing._State(tmp_path), []
    assert (state.features, state.pairs, state.poses) == (True, 4, False)

    class Stand:
        FeatureMatchingOptions = TwoViewGeometryOptions = staticmethod(lambda **_: _Any())
        ImportedPairingOptions = staticmethod(lambda: _Any())
        Device = pycolmap.Device

        @staticmethod
        def match_image_pairs(database, **_):
            matched.extend(database.with_name("pairs.txt").read_text().splitlines())

    how = {"seed": 0, "threads": 0, "tell": lambda *_: None}
    posing.match_pairs(
        Stand, tmp_path / "d.db", list("abcd"), first=state.pairs, matched=lambda pairs: state.save(pairs=pairs), **how
    )
    assert matched == ["b d", "c d"]  # the last two of six


class _Any:
    def __init__(self):
        self.ransac = self


def test_a_library_that_is_too_old_or_does_not_load_is_said_before_the_work(sweeps, tmp_path, monkeypatch):
    monkeypatch.setattr(creation, "extract_frames", None)  # not reached
    old = ModuleType("pycolmap")
    old.__version__ = "3.11.0"
    monkeypatch.setitem(sys.modules, "pycolmap", old)
    with pytest.raises(ImportError, match=r"pycolmap 3\.11\.0 lacks extract_features, .*pip install 'pycolmap>=4\.2'"):
        make_capture(*sweeps, tmp_path / "out")
    monkeypatch.delitem(sys.modules, "pycolmap")
    (tmp_path / "site" / "pycolmap").mkdir(parents=True)
    monkeypatch.syspath_prepend(tmp_path / "site")
    source = (
        "try:\n raise ImportError('libcudart.so.12: no such file')\nexcept ImportError as e:\n"
        " raise RuntimeError('no backend')"
    )
    for text, reason in (
        (source + " from e", r"libcudart\.so\.12: no such file"),
        ("raise OSError('GLIBC_2.99')", "GLIBC_2.99"),
        ("import absent_part", "needs absent_part, which is missing"),
    ):
        (tmp_path / "site" / "pycolmap" / "__init__.py").write_text(text)
        with pytest.raises(ImportError, match=f"pycolmap is installed and .*{reason}"):
            make_capture(*sweeps, tmp_path / "out")
        sys.modules.pop("pycolmap", None)
    assert {path.name for path in tmp_path.iterdir()} == {"walk", "back", "site"}


def test_a_colmap_of_another_distribution_has_a_version(sweeps, tmp_path, monkeypatch):
    """pycolmap-cuda12 installs the module, and importlib.metadata knows no pycolmap."""
    from importlib import metadata

    def unknown(name):
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "version", unknown)
    _Colmap(monkeypatch)
    assert make_capture(*sweeps, tmp_path / "out")["versions"]["pycolmap"] == pycolmap.__version__
