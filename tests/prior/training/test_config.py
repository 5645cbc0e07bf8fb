import json

import pytest

from unghost.prior.training.config import TrainConfig


def test_round_trip_through_json():
    config = TrainConfig(steps=7, max_seconds=3.0)
    assert TrainConfig.from_dict(json.loads(config.to_json())) == config


def test_unknown_keys_are_refused_and_known_ones_listed():
    with pytest.raises(ValueError, match=r"unknown keys \['epochs'\]; known: .*, steps, "):
        TrainConfig.from_dict({"epochs": 3})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"steps": 0}, "steps must be finite and > 0, got 0"),
        ({"learning_rate": float("nan")}, "learning_rate"),
        ({"weight_decay": -1.0}, "weight_decay must be finite and >= 0"),
        ({"ema_decay": 1.0}, "ema_decay"),
        ({"max_seconds": 0.0}, "max_seconds"),
        ({"precision": "fp16"}, "precision must be"),
    ],
)
def test_refuses(change, message):
    with pytest.raises(ValueError, match=message):
        TrainConfig(**change)


def test_learning_rate_by_hand():
    config = TrainConfig(learning_rate=1.0, warmup_steps=3, final_rate=0.1)
    assert [config.learning_rate_at(step, 0.0) for step in (0, 1, 3, 100)] == pytest.approx([0.25, 0.5, 1.0, 1.0])
    assert config.learning_rate_at(100, 0.5) == pytest.approx(0.55)  # halfway between 1 and .1
    assert config.learning_rate_at(100, 1.0) == pytest.approx(0.1)
    assert config.learning_rate_at(100, 7.0) == pytest.approx(0.1)
