"""nerfstudio's cameras as ours, without nerfstudio: stand-ins with the attributes that are read."""

import enum
import importlib
import sys
import types

import numpy as np
import pytest

torch = pytest.importorskip("torch")


class CameraType(enum.Enum):
    """The first three of nerfstudio's."""

    PERSPECTIVE = 1
    FISHEYE = 2
    EQUIRECTANGULAR = 3


@pytest.fixture
def cameras_of(monkeypatch):
    names = ["nerfstudio", "nerfstudio.models", "nerfstudio.models.nerfacto", "nerfstudio.cameras"]
    modules = {name: types.ModuleType(name) for name in [*names, "nerfstudio.cameras.cameras"]}
    modules["nerfstudio.models.nerfacto"].NerfactoModel = type("NerfactoModel", (), {})
    modules["nerfstudio.models.nerfacto"].NerfactoModelConfig = type("NerfactoModelConfig", (), {})
    modules["nerfstudio.cameras.cameras"].CameraType = CameraType
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    name = "unghost.integrations.nerfstudio.model"
    monkeypatch.delitem(sys.modules, name, raising=False)
    yield importlib.import_module(name).cameras_of
    sys.modules.pop(name, None)


def theirs(kinds, bend):
    count = len(kinds)
    column = {name: torch.tensor([[value]] * count) for name, value in dict(fx=20.0, fy=21.0, cx=16.0, cy=12.0).items()}
    return types.SimpleNamespace(
        camera_type=torch.tensor([[kind.value] for kind in kinds]),
        width=torch.tensor([[32], [64]][:count]),
        height=torch.tensor([[24], [48]][:count]),
        camera_to_worlds=torch.eye(4)[None, :3].repeat(count, 1, 1),
        distortion_params=torch.tensor(bend),
        **column,
    )


def test_fisheyes_stay_fisheyes_and_sizes_become_the_first(cameras_of):
    bend = [[0.05, -0.01, 0.002, 0.0, 0.0, 0.0], [0.1, 0.0, 0.0, 0.0, 1e-3, 0.0]]
    found = cameras_of(theirs([CameraType.FISHEYE, CameraType.PERSPECTIVE], bend))
    assert found.fisheye.tolist() == [True, False]
    assert (found.width, found.height) == (32, 24)
    np.testing.assert_allclose(found.intrinsics, [[20, 21, 16, 12], [10, 10.5, 8, 6]])
    np.testing.assert_allclose(found.distortion, bend, atol=1e-8)


def test_other_kinds_are_refused(cameras_of):
    with pytest.raises(ValueError, match=r"perspective ones or fisheyes, got camera_type \[1, 3\]"):
        cameras_of(theirs([CameraType.PERSPECTIVE, CameraType.EQUIRECTANGULAR], [[0.0] * 6] * 2))
