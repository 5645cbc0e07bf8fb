import dataclasses
import json
from typing import Any, Literal

import pytest

from unghost.core.config import check_keys, from_dict, nearest, override, to_dict


@dataclasses.dataclass(frozen=True)
class Inner:
    width: int = 8


@dataclasses.dataclass(frozen=True)
class Outer:
    name: str
    steps: int = 10
    rate: float = 0.1
    limit: float | None = None
    flag: bool = False
    mode: Literal["a", "b"] = "a"
    pair: tuple[float, float] = (0.0, 1.0)
    names: tuple[str, ...] = ()
    inner: Inner = dataclasses.field(default_factory=Inner)
    extra: dict[str, Any] = dataclasses.field(default_factory=dict)


FULL = Outer("n", 3, 2.0, 4.0, True, "b", (1.0, 2.0), ("x", "y"), Inner(4), {"k": [1]})


def test_round_trip_through_json():
    plain = json.loads(json.dumps(to_dict(FULL)))
    assert plain == to_dict(FULL)
    assert plain["pair"] == [1.0, 2.0]
    assert plain["inner"] == {"width": 4}
    assert from_dict(Outer, plain, nested={"inner": lambda values: from_dict(Inner, values)}) == FULL


def test_absent_keys_take_their_defaults_and_none_is_changed():
    values = {"name": "n", "pair": [0, 1]}
    assert from_dict(Outer, values) == Outer("n")
    assert values == {"name": "n", "pair": [0, 1]}


def test_whole_numbers_become_floats_and_nothing_else_is_converted():
    made = from_dict(Outer, {"name": "n", "rate": 1, "limit": 2, "pair": [0, 1]})
    assert [type(value) for value in (made.rate, made.limit, *made.pair)] == [float] * 4


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ([], r"^Outer: must be a table of keys and values, got \[\]"),
        ("name", "^Outer: must be a table"),
        ({}, r"^Outer: keys \['name'\] are missing"),
        (
            {"name": "n", "step": 1},
            r"^Outer: unknown keys \['step'\] \(did you mean steps\?\); known: name, steps, rate",
        ),
        ({"name": "n", "zzz": 1, "qqq": 1}, r"unknown keys \['qqq', 'zzz'\]; known: name"),
        ({"name": 3}, "^Outer: name must be str, got 3"),
        ({"name": "n", "steps": 1.0}, r"^Outer: steps must be int, got 1\.0"),
        ({"name": "n", "steps": True}, "^Outer: steps must be int, got True"),
        ({"name": "n", "rate": "1"}, "^Outer: rate must be float, got '1'"),
        ({"name": "n", "limit": "1"}, r"^Outer: limit must be float \| None, got '1'"),
        ({"name": "n", "flag": 1}, "^Outer: flag must be bool, got 1"),
        ({"name": "n", "mode": 1}, r"^Outer: mode must be Literal\['a', 'b'\], got 1"),
        ({"name": "n", "pair": 1}, r"^Outer: pair must be tuple\[float, float\], got 1"),
        ({"name": "n", "pair": [0, "1"]}, r"^Outer: pair must be tuple\[float, float\], got \[0, '1'\]"),
        ({"name": "n", "extra": []}, r"^Outer: extra must be dict\[str, Any\], got \[\]"),
    ],
)
def test_refusals(values, message):
    with pytest.raises(ValueError, match=message):
        from_dict(Outer, values)


def test_the_caller_and_the_word_for_keys_are_the_callers():
    with pytest.raises(ValueError, match=r"^file\.json: unknown manifest keys \['zzz'\]"):
        from_dict(Inner, {"zzz": 1}, caller="file.json", what="manifest keys")


def test_override():
    assert override(Inner(), {}, caller="f") == Inner()
    assert override(Inner(), {"width": 2}, caller="f") == Inner(2)
    with pytest.raises(TypeError, match=r"^f: unknown settings \['widht'\] \(did you mean width\?\); known: width$"):
        override(Inner(), {"widht": 2}, caller="f")


def test_nearest_and_check_keys():
    assert nearest(["stepz", "zzz"], ["steps", "seed"]) == " (did you mean steps?)"
    assert nearest([], ["steps"]) == ""
    check_keys([], [], caller="f")
    check_keys(["steps"], ["seed", "steps"], caller="f")
    with pytest.raises(ValueError, match=r"^f: unknown families \['b'\]; known: seed$"):
        check_keys(["b", "seed"], ["seed"], caller="f", what="families")
