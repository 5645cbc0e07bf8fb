import contextlib
import io
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from unghost.fields.adapters import msgpack_stream
from unghost.fields.adapters.msgpack_stream import MsgpackError, read_msgpack


def pack(value):
    """The specification's shortest form of a value, written here from its table alone."""
    if value is None:
        return b"\xc0"
    if isinstance(value, bool):
        return b"\xc3" if value else b"\xc2"
    if isinstance(value, int):
        if -32 <= value < 128:
            return struct.pack(">b", value)
        for code, tag, low, high in (
            (">B", 0xCC, 0, 2**8),
            (">H", 0xCD, 0, 2**16),
            (">I", 0xCE, 0, 2**32),
            (">Q", 0xCF, 0, 2**64),
            (">b", 0xD0, -(2**7), 0),
            (">h", 0xD1, -(2**15), 0),
            (">i", 0xD2, -(2**31), 0),
            (">q", 0xD3, -(2**63), 0),
        ):
            if low <= value < high:
                return bytes([tag]) + struct.pack(code, value)
    if isinstance(value, float):
        return b"\xcb" + struct.pack(">d", value)
    if isinstance(value, str):
        data = value.encode()
        return _head(len(data), 0xA0, 32, (0xD9, 0xDA, 0xDB)) + data
    if isinstance(value, bytes):
        return _head(len(value), 0, 0, (0xC4, 0xC5, 0xC6)) + value
    if isinstance(value, list):
        return _head(len(value), 0x90, 16, (None, 0xDC, 0xDD)) + b"".join(map(pack, value))
    return _head(len(value), 0x80, 16, (None, 0xDE, 0xDF)) + b"".join(pack(k) + pack(v) for k, v in value.items())


def _head(count, short, below, tags):
    if count < below:
        return bytes([short | count])
    for tag, code, high in zip(tags, (">B", ">H", ">I"), (2**8, 2**16, 2**32)):
        if tag is not None and count < high:
            return bytes([tag]) + struct.pack(code, count)
    raise AssertionError


def read(data, wanted=lambda path, count: True):
    return read_msgpack(io.BytesIO(data), wanted=wanted)


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats(allow_nan=False) | st.text() | st.binary(),
    lambda inner: st.lists(inner, max_size=20) | st.dictionaries(st.text(max_size=40), inner, max_size=20),
    max_leaves=30,
)


@settings(deadline=None, max_examples=50)
@given(VALUES)
def test_round_trip(value):
    assert read(pack(value)) == value


@pytest.mark.parametrize("length", [0, 15, 16, 31, 32, 255, 256, 65535, 65536])
def test_every_length(length):
    for value in ("a" * length, b"a" * length, [1] * length, {str(i): None for i in range(length)}):
        assert read(pack(value)) == value


@settings(deadline=None, max_examples=50)
@given(VALUES, st.data())
def test_cut_short(value, data):
    whole = pack(value)
    with pytest.raises(MsgpackError):
        read(whole[: data.draw(st.integers(0, len(whole) - 1))])


@given(st.binary(max_size=200))
def test_noise_raises_nothing_else(noise):
    with contextlib.suppress(MsgpackError):
        read(noise)


def test_binary_that_is_not_wanted_is_skipped():
    seen = []

    def wanted(path, count):
        seen.append((path, count))
        return path == ("a", "keep")

    content = {"a": {"keep": b"xy", "drop": b"z" * 3_000_000}, "list": [b"q"], "after": 5}
    assert read(pack(content), wanted) == {"a": {"keep": b"xy", "drop": None}, "list": [None], "after": 5}
    assert seen == [(("a", "keep"), 2), (("a", "drop"), 3_000_000), (("list", "[]"), 1)]


def test_floats_and_extensions():
    assert read(b"\xca" + struct.pack(">f", 1.5)) == 1.5
    assert read(b"\x93\xd6\x01abcd\xc7\x03\x05xyz\x07") == [None, None, 7]


@pytest.mark.parametrize(
    ("data", "rule"),
    [
        (b"", "ends early: 1 more"),
        (b"\xc1", "0xc1, which MessagePack never uses"),
        (b"\xdd\xff\xff\xff\xff", "4294967295 entries"),
        (b"\xdf\xff\xff\xff\xff", "4294967295 entries"),
        (b"\xdb\xff\xff\xff\xff", "texts of 4294967295 bytes"),
        (b"\xc6\xff\xff\xff\xff", "ends early"),
        (b"\x91" * 100 + b"\x01", "nested more than 32 deep"),
        (b"\x81\x01\x01", "a key that is no text"),
        (pack({"a": 1})[:-1].replace(b"\x81", b"\x82") + b"\x01" + pack("a") + b"\x02", "comes twice: 'a'"),
        (b"\xa2\xff\xfe", "not UTF-8"),
    ],
)
def test_hostile(data, rule):
    with pytest.raises(MsgpackError, match=rule):
        read(data)


def test_the_sum_of_many_small_things_is_bounded(monkeypatch):
    monkeypatch.setattr(msgpack_stream, "MOST_ITEMS", 100)
    with pytest.raises(MsgpackError, match="100 values"):
        read(pack([[1] * 30] * 4))
    monkeypatch.setattr(msgpack_stream, "MOST_TEXT", 100)
    with pytest.raises(MsgpackError, match="texts of 120 bytes"):
        read(pack(["a" * 30] * 4))


def test_skipping_takes_no_memory():
    class Endless(io.RawIOBase):
        """A header of four gigabytes, and zeros as long as anybody reads."""

        left = b"\x91\xc6\xff\xff\xff\xff"
        largest = 0

        def read(self, count=-1):
            self.largest = max(self.largest, count)
            data, self.left = self.left[:count], self.left[count:]
            if self.largest > 1 and self.total(count) > 50_000_000:
                return b""
            return data or bytes(count)

        given = 0

        def total(self, count):
            self.given += count
            return self.given

    stream = Endless()
    with pytest.raises(MsgpackError, match="ends early"):
        read_msgpack(stream, wanted=lambda path, count: False)
    assert stream.largest <= 1 << 20
