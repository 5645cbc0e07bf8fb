"""A shard as files: golden bytes, and every way in which files can disagree."""

import errno
import hashlib
import json
import pathlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from unghost.core.shards.packing import pack_labels, unpack_labels
from unghost.core.shards.storage import ARRAYS, OPTIONAL_ARRAYS, read_shard, write_shard

GOLDEN = {  # of the shard that `arrays` makes below; a change of these bytes is a change of the format
    "inputs": "2bd3ed2069e857c1432cdcf698c7ccc5e6c3f29e9f00e945283313d2349e04ee",
    "labels": "10ab8b581e864b697f597c0f4c05e1278888612bc5e6c3e1564f18222eb22bc3",
    "severity": "3623d9deebc035f4a8eb993baf814f2f4f33d8eadded45f519bf0a1d5da11a12",
    "edge_fraction": "3d9f06ab49bd336909d2bb0e3e129fe432276fcf7690abbcfef7c3387de76b56",
    "group": "28d4b63fdadd72ed19f8fad1638746569959d59ee50d3e10d67810fced9dc78f",
}
OPTIONAL_GOLDEN = {  # of `optional` below
    "surroundings": "abe967333828afa4c583c96182bd02b0a3f61b37f136d6bdc090968dec48cb9b",
    "view_count": "9449251a75a68516f5dc76752f18b9c357586cdbed4303c5b8f0edf3200d5ba3",
    "transmittance": "0049f0c8bd18657fd9d9fd22c1630b6a408eb4405bf2ba9843bb17ed491420ca",
    "support": "2d7542537ffa14f05cb1224f820940eb03a729349fb20554abd19430430dc642",
    "crossings": "6875b56182fb65a6cf4f569543951eabbca564520570c95cdcfc03551c54bd7d",
    "frames": "224ee94ea3dd006d5a83afdbd375d4b1c82b1ea046362013f65a92a5bab0f38c",
    "source": "c461e9435ee35ce314b3e42cf27575b055fecf1f8272fee6af2d8840c4aff870",
}
SOURCES = {"sources": [{"path": "chairs/one.glb", "sha256": "0" * 64, "licence": "CC0-1.0"}]}


def test_golden_bytes(shard):
    found = {name: hashlib.sha256((shard / f"{name}.npy").read_bytes()).hexdigest() for name in ARRAYS}
    assert found == GOLDEN
    assert sorted(path.name for path in shard.iterdir()) == sorted(
        [*(f"{name}.npy" for name in ARRAYS), "manifest.json"]
    )
    manifest = json.loads((shard / "manifest.json").read_text(encoding="utf-8"))
    assert manifest == {
        "format": "unghost-shard",
        "format_version": 1,
        "count": 2,
        "kind": "pairs",
        "sha256": GOLDEN,
        "provenance": {"recipe": "test", "seed": 3},
    }


def test_golden_manifest_of_a_harvest(tmp_path, arrays):
    write_shard(tmp_path / "s", arrays(), {"recipe": "test"}, kind="harvest")
    text = (tmp_path / "s" / "manifest.json").read_text(encoding="utf-8")
    hashes = ",\n".join(f'  "{name}": "{digest}"' for name, digest in GOLDEN.items())
    assert text == (
        '{\n "format": "unghost-shard",\n "format_version": 1,\n "count": 2,\n "kind": "harvest",\n'
        f' "sha256": {{\n{hashes}\n }},\n "provenance": {{\n  "recipe": "test"\n }}\n}}'
    )
    assert read_shard(tmp_path / "s").kind == "harvest"


@pytest.mark.parametrize(
    ("provenance", "kind"),
    [
        ({"recipe": "harvest"}, "harvest"),
        ({"recipe": "rooms"}, "pairs"),
        ({"recipe": {"name": "x"}}, "pairs"),
        ({}, "pairs"),
    ],
)
def test_the_kind_of_a_manifest_without_one_comes_from_its_recipe(shard, provenance, kind):
    path = shard / "manifest.json"
    manifest = json.loads(path.read_text(encoding="utf-8")) | {"provenance": provenance}
    del manifest["kind"]
    path.write_text(json.dumps(manifest), encoding="utf-8")
    assert read_shard(shard, verify=True).kind == kind


@pytest.mark.parametrize("kind", ["Harvest", "", None, 1, ["pairs"]])
def test_unknown_kinds_are_refused(shard, tmp_path, arrays, kind):
    with pytest.raises(ValueError, match="write_shard: kind must be one of pairs, harvest, got"):
        write_shard(tmp_path / "s", arrays(), {}, kind=kind)
    assert not (tmp_path / "s").exists()
    path = shard / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text(encoding="utf-8")) | {"kind": kind}), encoding="utf-8")
    with pytest.raises(ValueError, match=r"read_shard: .*manifest.json: kind must be one of pairs, harvest, got"):
        read_shard(shard)


def test_round_trip_is_memory_mapped(shard, arrays):
    read = read_shard(shard, verify=True)
    assert len(read) == 2
    assert read.provenance == {"recipe": "test", "seed": 3}
    for name, array in arrays().items():
        np.testing.assert_array_equal(getattr(read, name), array)
    assert isinstance(read.inputs, np.memmap)


def test_a_shard_of_nothing_is_a_shard(tmp_path, arrays, optional):
    nothing = pack_labels(np.zeros((0, 32, 32, 32), dtype=np.uint8))
    assert (nothing.shape, nothing.dtype) == ((0, 8192), np.uint8)
    assert unpack_labels(nothing).shape == (0, 32, 32, 32)
    emptied = {name: array[:0] for name, array in (arrays() | optional()).items()}
    write_shard(tmp_path / "s", emptied, {"sources": []})
    shard = read_shard(tmp_path / "s", verify=True)
    assert len(shard) == 0
    for name, array in emptied.items():
        found = getattr(shard, name)
        assert (found.shape, found.dtype) == (array.shape, array.dtype)
        np.load(tmp_path / "s" / f"{name}.npy", allow_pickle=False)
    assert unpack_labels(shard.labels).shape == (0, 32, 32, 32)


def test_an_existing_folder_is_never_overwritten(shard, arrays):
    with pytest.raises(FileExistsError, match="exists already"):
        write_shard(shard, arrays(), {})


@pytest.mark.parametrize(("name", "wrong"), [("group", np.zeros(2)), ("labels", np.zeros((2, 5), np.uint8))])
def test_wrong_arrays_leave_nothing_behind(tmp_path, name, wrong, arrays):
    with pytest.raises(ValueError, match=f"write_shard: {name} must be"):
        write_shard(tmp_path / "s", arrays() | {name: wrong}, {})
    assert not list(tmp_path.iterdir())


def test_an_unfinished_shard_is_refused_and_can_be_written_again(tmp_path, arrays):
    half = tmp_path / "s.partial"
    half.mkdir()
    (half / "inputs.npy").write_bytes(b"rubbish")
    with pytest.raises(ValueError, match=r"has no manifest\.json: not a shard, or unfinished"):
        read_shard(half)
    write_shard(tmp_path / "s", arrays(), {})
    assert len(read_shard(tmp_path / "s", verify=True)) == 2
    assert not half.exists()


def test_truncated_arrays_are_refused(shard):
    path = shard / "inputs.npy"
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(ValueError, match=r"cannot read .*inputs\.npy"):
        read_shard(shard)


def test_missing_arrays_are_refused(shard):
    (shard / "group.npy").unlink()
    with pytest.raises(ValueError, match=r"cannot read .*group\.npy"):
        read_shard(shard)


def test_a_flipped_bit_is_found_by_verify(shard):
    path = shard / "labels.npy"
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    read_shard(shard)
    with pytest.raises(ValueError, match=r"labels\.npy does not match the hash"):
        read_shard(shard, verify=True)


def test_another_count_is_refused(shard):
    path = shard / "manifest.json"
    manifest = json.loads(path.read_text(encoding="utf-8"))
    path.write_text(json.dumps(manifest | {"count": 3}), encoding="utf-8")
    with pytest.raises(ValueError, match="the manifest says"):
        read_shard(shard)


@pytest.mark.parametrize("text", ["{", '{"format": "zip"}', '{"format": "unghost-shard", "format_version": 9}'])
def test_foreign_manifests_are_refused(shard, text):
    (shard / "manifest.json").write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match="read_shard: "):
        read_shard(shard)


def test_pickles_are_never_loaded(shard):
    np.save(shard / "group.npy", np.array([{"a": 1}, None], dtype=object), allow_pickle=True)
    with pytest.raises(ValueError, match=r"cannot read .*group\.npy"):
        read_shard(shard)


@pytest.mark.parametrize("name", OPTIONAL_ARRAYS)
def test_golden_bytes_of_optional_arrays(tmp_path, name, arrays, optional):
    write_shard(tmp_path / "s", arrays() | {name: optional()[name]}, SOURCES)
    assert hashlib.sha256((tmp_path / "s" / f"{name}.npy").read_bytes()).hexdigest() == OPTIONAL_GOLDEN[name]
    manifest = json.loads((tmp_path / "s" / "manifest.json").read_text(encoding="utf-8"))
    assert manifest["sha256"] == GOLDEN | {name: OPTIONAL_GOLDEN[name]}
    assert manifest["format_version"] == 1
    shard = read_shard(tmp_path / "s", verify=True)
    for other in OPTIONAL_ARRAYS:
        if other == name:
            assert isinstance(getattr(shard, other), np.memmap)
            np.testing.assert_array_equal(getattr(shard, other), optional()[other])
        else:
            assert getattr(shard, other) is None


@pytest.mark.parametrize(("missing", "extra"), [("severity", None), (None, "normals")])
def test_missing_and_unknown_arrays_are_named(tmp_path, missing, extra, arrays):
    given_arrays = arrays() | ({extra: np.zeros(2)} if extra else {})
    given_arrays.pop(missing, None)
    with pytest.raises(ValueError, match=f"write_shard: arrays must hold.*{missing or extra}"):
        write_shard(tmp_path / "s", given_arrays, {})


def test_an_optional_array_is_there_exactly_if_the_manifest_names_it(tmp_path, arrays, optional):
    write_shard(tmp_path / "s", arrays() | optional(), SOURCES)
    path = tmp_path / "s" / "manifest.json"
    manifest = json.loads(path.read_text(encoding="utf-8"))
    hashes = dict(manifest["sha256"])
    for changed, rule in (
        ({k: v for k, v in hashes.items() if k != "view_count"}, r"not named \['view_count'\], unknown \[\]"),
        ({k: v for k, v in hashes.items() if k != "group"}, r"not named \['group'\]"),
        (hashes | {"normals": "0"}, r"unknown \['normals'\]"),
    ):
        path.write_text(json.dumps(manifest | {"sha256": changed}), encoding="utf-8")
        with pytest.raises(ValueError, match=f"read_shard: .* disagree: .*{rule}"):
            read_shard(tmp_path / "s")
    path.write_text(json.dumps(manifest), encoding="utf-8")
    (tmp_path / "s" / "frames.npy").unlink()
    with pytest.raises(ValueError, match=r"cannot read .*frames\.npy"):
        read_shard(tmp_path / "s")


def test_overlong_and_transposed_arrays_are_refused(shard, arrays):
    path = shard / "severity.npy"
    path.write_bytes(path.read_bytes() + b"\0\0\0")
    with pytest.raises(ValueError, match=r"severity\.npy is 3 bytes longer than its array"):
        read_shard(shard)
    np.save(path, arrays()["severity"])
    np.save(shard / "inputs.npy", np.asfortranarray(arrays()["inputs"]))
    with pytest.raises(ValueError, match="C order"):
        read_shard(shard)


@pytest.mark.parametrize(
    ("key", "value"), [("count", None), ("count", True), ("count", "2"), ("sha256", []), ("provenance", None)]
)
def test_manifests_that_lack_something_are_refused(shard, key, value):
    path = shard / "manifest.json"
    manifest = json.loads(path.read_text(encoding="utf-8"))
    path.write_text(json.dumps(manifest | {key: value}), encoding="utf-8")
    with pytest.raises(ValueError, match=f"must hold {key}"):
        read_shard(shard)


@pytest.mark.parametrize("content", [b"[]", b"null", b"\xff\xfe{", b"[" * 100_000])
def test_manifests_that_are_no_object_are_refused(shard, content):
    (shard / "manifest.json").write_bytes(content)
    with pytest.raises(ValueError, match="read_shard: "):
        read_shard(shard)


@pytest.mark.parametrize("where", ["inputs", "severity", "manifest"])
def test_a_full_disk_is_named_and_leaves_nothing(tmp_path, monkeypatch, where, arrays):
    real = pathlib.Path.open

    def full(self, *args, **kwargs):  # /dev/full fails as a full disk does, with ENOSPC on writing
        return real(pathlib.Path("/dev/full") if self.stem == where else self, *args, **kwargs)

    monkeypatch.setattr(pathlib.Path, "open", full)
    with pytest.raises(OSError, match=r"write_shard: cannot write .*No space left on device") as caught:
        write_shard(tmp_path / "s", arrays(), {})
    assert caught.value.errno == errno.ENOSPC
    assert not list(tmp_path.iterdir())
    monkeypatch.undo()
    write_shard(tmp_path / "s", arrays(), {})
    read_shard(tmp_path / "s", verify=True)


@settings(deadline=None)
@given(st.integers(0, 5), st.floats(0, 1, exclude_max=True))
def test_a_shard_cut_anywhere_is_refused(whole, which, share):
    folder, files = whole
    path = folder / [*(f"{name}.npy" for name in ARRAYS), "manifest.json"][which]
    path.write_bytes(files[path.name][: int(share * len(files[path.name]))])
    try:
        with pytest.raises(ValueError, match="read_shard: "):
            read_shard(folder)
    finally:
        path.write_bytes(files[path.name])


@pytest.fixture(scope="module")
def whole(tmp_path_factory, arrays):
    folder = tmp_path_factory.mktemp("whole") / "s"
    write_shard(folder, arrays(), {})
    return folder, {path.name: path.read_bytes() for path in folder.iterdir()}
