import pytest

from unghost import cli
from unghost.cli import recipes as commands_recipes
from unghost.data_recipes.harvest import run as module


@pytest.fixture
def configs(monkeypatch):
    """What the verb asks for, instead of doing it."""
    asked = []
    monkeypatch.setattr(module, "harvest", lambda out, **options: asked.append(options["config"]) or 0)
    return asked


def test_kinds_and_shares_reach_the_harvest(configs, tmp_path):
    commands_recipes.harvest(tmp_path)
    assert cli.main(["harvest", "--out", str(tmp_path), "--kinds", "mlp", "--cubes", "7", "--steps", "3", "9"]) == 0
    commands_recipes.harvest(tmp_path, kinds=("dense=1", "hash=2.5"))
    assert configs[0] == module.HarvestConfig()
    assert configs[0].kinds == ("dense", "hash")
    assert (configs[1].kinds, configs[1].shares, configs[1].cubes, configs[1].steps) == (("mlp",), (1.0,), 7, (3, 9))
    assert (configs[2].kinds, configs[2].shares) == (("dense", "hash"), (1.0, 2.5))


@pytest.mark.parametrize(
    ("kinds", "message"),
    [
        (("dense=much",), "--kinds must be NAME or NAME=SHARE, the share a number, got 'dense=much'"),
        (("splat",), "kinds must be different ones of dense, hash, mlp, got"),
        (("hash=0",), r"shares must be one finite number > 0 for each of .* got \(0.0,\)"),
        (("hash=inf",), "shares must be one finite number > 0"),
    ],
)
def test_bad_kinds_are_refused(configs, tmp_path, kinds, message):
    with pytest.raises(ValueError, match=message):
        commands_recipes.harvest(tmp_path, kinds=kinds)
    assert configs == []
