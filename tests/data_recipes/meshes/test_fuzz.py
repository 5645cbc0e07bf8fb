"""Whatever the bytes, one of the three ends, and never a mesh that is not finite or not at unit size."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from unghost.data_recipes.meshes.files import read_mesh_file
from unghost.data_recipes.meshes.reading import MeshEmpty, MeshRejected

pytest.importorskip("trimesh")

KINDS = ("off", "ply", "binary ply", "stl", "binary stl", "gltf", "glb", "dae", "obj")  # of samples.valid
SUFFIXES = ("obj", "off", "ply", "stl", "gltf", "glb", "dae")


@pytest.fixture(scope="module")
def outcome(tmp_path_factory, area):
    folder = tmp_path_factory.mktemp("fuzz")

    def end(data, suffix):
        path = folder / f"mesh.{suffix}"
        path.write_bytes(data)
        try:
            read, reason = read_mesh_file(path), ""
        except (MeshEmpty, MeshRejected) as error:
            read, reason = None, str(error)
        if read is None:
            assert reason
            return None
        assert np.isfinite(read.triangles).all()
        assert np.ptp(read.triangles.reshape(-1, 3), axis=0).max() <= 1 + 1e-12
        assert (area(read.triangles) > 0).all()
        return read

    return end


@given(st.sampled_from(SUFFIXES), st.binary(max_size=400))
@settings(max_examples=150, deadline=None)
def test_any_bytes_end_well(outcome, suffix, data):
    outcome(data, suffix)


@given(st.sampled_from(KINDS), st.binary(max_size=200))
@settings(max_examples=100, deadline=None)
def test_any_bytes_behind_a_sound_beginning_end_well(outcome, samples, kind, data):
    suffix, whole = samples.valid[kind]
    outcome(whole[: len(whole) // 2] + data, suffix)


@pytest.mark.slow
@given(st.sampled_from(KINDS), st.lists(st.tuples(st.floats(0, 1), st.integers(0, 255)), min_size=1, max_size=4))
@settings(max_examples=200, deadline=None)
def test_changed_bytes_end_well(outcome, samples, kind, changes):
    suffix, whole = samples.valid[kind]
    data = bytearray(whole)
    for place, byte in changes:
        data[int(place * (len(data) - 1))] = byte
    outcome(bytes(data), suffix)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS[:-1])
def test_a_cut_file_is_never_another_mesh(outcome, samples, kind):
    """At every length: refused, empty, or all of it. (OBJ has no end, so a cut OBJ can be a smaller OBJ.)"""
    suffix, whole = samples.valid[kind]
    full = outcome(whole, suffix)
    assert full is not None
    for length in range(len(whole)):
        read = outcome(whole[:length], suffix)
        assert read is None or np.array_equal(read.triangles, full.triangles), f"{length} of {len(whole)} bytes"
