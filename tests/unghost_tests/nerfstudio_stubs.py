"""Stand-ins for the parts of nerfstudio that the plug-in imports, with the attributes that are read."""

import enum
import importlib
import sys
import types

import torch

MODEL = "unghost.integrations.nerfstudio.model"


class CameraType(enum.Enum):
    """The first three of nerfstudio's."""

    PERSPECTIVE = 1
    FISHEYE = 2
    EQUIRECTANGULAR = 3


class NerfactoModel:
    """Without losses and callbacks of its own."""

    def get_loss_dict(self, outputs, batch, metrics_dict=None):
        return {"rgb_loss": torch.zeros(())}

    def get_training_callbacks(self, training_callback_attributes):
        return []


class Console:
    """Keeps what is logged."""

    def __init__(self):
        self.lines = []

    def log(self, line):
        self.lines.append(line)


def import_model(monkeypatch):
    """The plug-in's model module over the stand-ins, and the console that it logs to; ``forget_model`` afterwards."""
    console = Console()
    contents = {
        "nerfstudio": {},
        "nerfstudio.models": {},
        "nerfstudio.models.nerfacto": {
            "NerfactoModel": NerfactoModel,
            "NerfactoModelConfig": type("NerfactoModelConfig", (), {}),
        },
        "nerfstudio.cameras": {},
        "nerfstudio.cameras.cameras": {"CameraType": CameraType},
        "nerfstudio.engine": {},
        "nerfstudio.engine.callbacks": {
            "TrainingCallback": lambda **told: types.SimpleNamespace(**told),
            "TrainingCallbackLocation": types.SimpleNamespace(BEFORE_TRAIN_ITERATION=0),
        },
        "nerfstudio.utils": {},
        "nerfstudio.utils.rich_utils": {"CONSOLE": console},
    }
    for name, attributes in contents.items():
        module = types.ModuleType(name)
        vars(module).update(attributes)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.delitem(sys.modules, MODEL, raising=False)
    return importlib.import_module(MODEL), console


def forget_model():
    sys.modules.pop(MODEL, None)


def theirs(poses, *, intrinsics, width, height, kinds=None, bend=None):
    """nerfstudio's cameras: poses ``(N, 3, 4)``, fx fy cx cy, sizes as numbers or one a camera."""
    count = len(poses)
    column = {name: torch.full((count, 1), float(value)) for name, value in zip(("fx", "fy", "cx", "cy"), intrinsics)}
    return types.SimpleNamespace(
        camera_type=torch.tensor([[kind.value] for kind in kinds or [CameraType.PERSPECTIVE] * count]),
        width=torch.as_tensor(width).expand(count)[:, None],
        height=torch.as_tensor(height).expand(count)[:, None],
        camera_to_worlds=torch.as_tensor(poses),
        distortion_params=None if bend is None else torch.tensor(bend),
        **column,
    )
