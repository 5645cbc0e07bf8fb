"""PLY files (Turk 1994): headers, and the plain numbers of the element ``vertex``, text or binary. numpy only."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .errors import InvalidFile, MissingFile
from .ply_types import PLY_TYPES

MOST_HEADER = 1 << 16
MOST_ELEMENTS, MOST_PROPERTIES = 64, 512
FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}  # -> byte order


@dataclass(frozen=True)
class Element:
    """One element of a PLY header.

    Attributes:
        name: ``vertex``, ``face``, …
        count: its rows.
        dtype: of a row, without its lists.
        list_bytes: least bytes that the lists of a row take (their lengths); 0 if it has none.

    Example:
        >>> Element("face", 2, np.dtype([]), 1).least_bytes
        2
    """

    name: str
    count: int
    dtype: np.dtype[np.void]
    list_bytes: int

    @property
    def least_bytes(self) -> int:
        """Bytes of all rows; more where there are lists."""
        return self.count * (self.dtype.itemsize + self.list_bytes)


@dataclass(frozen=True)
class PlyHeader:
    """What stands before the body of a PLY file.

    Attributes:
        order: ``""`` for text, ``"<"`` or ``">"`` for binary.
        elements: in their order.
        lines: of the header without ``end_header``, without the line's end.
        begins: offset of the body, bytes.
    """

    order: str
    elements: tuple[Element, ...]
    lines: tuple[str, ...]
    begins: int

    @property
    def place(self) -> int:
        """Index of the one element ``vertex``; neither it nor an element before it has lists.

        Raises:
            InvalidFile: it is missing, there are two, or there are lists.
        """
        names = [element.name for element in self.elements]
        if names.count("vertex") != 1:
            raise InvalidFile(f"its header must name one element vertex, got {', '.join(names) or 'none'}")
        place = names.index("vertex")
        listed = [element.name for element in self.elements[: place + 1] if element.list_bytes and element.count]
        if listed:
            raise InvalidFile(f"element {listed[0]} has a list property; only elements behind vertex may")
        return place


def parse_header(start: bytes, *, formats: Sequence[str] = tuple(FORMATS)) -> PlyHeader:
    """Parse the header of a PLY file; lines end with LF or CR LF.

    Args:
        start: first bytes of the file, at least its header.
        formats: those that are accepted.

    Raises:
        InvalidFile: it is none, or of another format; the message is the rule, for a caller that names the file.

    Example:
        >>> header = parse_header(b"ply\\nformat ascii 1.0\\nelement vertex 1\\nproperty float x\\nend_header\\n0.5\\n")
        >>> header.elements[header.place].dtype.names, header.begins
        (('x',), 66)
    """
    end = start.find(b"\nend_header")
    tail = start[end + 11 : end + 13]
    if not start.startswith((b"ply\n", b"ply\r\n")) or end < 0 or not tail.startswith((b"\n", b"\r\n")):
        raise InvalidFile("it has no PLY header")
    lines = tuple(line.rstrip("\r") for line in start[:end].decode("latin-1").split("\n"))
    order, elements = _elements(lines[1:], formats)
    return PlyHeader(order, elements, lines, end + (12 if tail.startswith(b"\n") else 13))


def _elements(lines: tuple[str, ...], formats: Sequence[str]) -> tuple[str, tuple[Element, ...]]:
    """The byte order, and the elements of a header in their order."""
    order: str | None = None
    properties = 0
    found: list[tuple[str, int, list[tuple[str, str]], list[int]]] = []
    for line in lines:
        words = line.split()
        if not words or words[0] in ("comment", "obj_info"):
            continue
        properties += words[0] == "property"
        if words[0] == "format" and len(words) == 3 and words[1] in formats and words[2] == "1.0":
            order = FORMATS[words[1]]
        elif words[0] == "element" and len(words) == 3 and words[2].isdecimal() and len(found) < MOST_ELEMENTS:
            found.append((words[1], int(words[2]), [], []))
        elif (
            words[0] == "property"
            and len(words) == 3
            and words[1] in PLY_TYPES
            and found
            and properties <= MOST_PROPERTIES
        ):
            found[-1][2].append((words[2], PLY_TYPES[words[1]]))
        elif (
            words[:2] == ["property", "list"]
            and len(words) == 5
            and words[3] in PLY_TYPES
            and PLY_TYPES.get(words[2], "f")[0] in "iu"
            and found
            and properties <= MOST_PROPERTIES
        ):
            found[-1][3].append(np.dtype(PLY_TYPES[words[2]]).itemsize)
        else:
            raise InvalidFile(f"the header's line {line[:60]!r} (wanted: {', '.join(formats)}, element, property)")
    if order is None or any(len(dict(fields)) != len(fields) for _, _, fields, _ in found):
        raise InvalidFile("its header names no format, or a property twice")
    return order, tuple(
        Element(name, count, np.dtype([(key, order + kind) for key, kind in fields]), sum(lists))
        for name, count, fields, lists in found
    )


def read_ply_vertices(path: str | Path, *names: str, caller: str = "read_ply_vertices") -> NDArray[np.float64]:
    """Read properties of the vertices of a PLY file, ``ascii`` or binary of either byte order.

    Args:
        path: of the file.
        names: of the properties, such as ``"x", "y", "z"``.
        caller: begins the message of an error.

    Returns:
        ``(N, len(names))`` float64, in the units of the file.

    Raises:
        MissingFile: there is no such file.
        InvalidFile: it is no PLY, lacks an element ``vertex`` or a property, has lists in or before ``vertex``, or is
            shorter or longer than its header says.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp(), "points.ply")
        >>> lines = ["ply", "format ascii 1.0", "element vertex 2", "property float x", "property uchar red"]
        >>> _ = path.write_text(chr(10).join([*lines, "end_header", "0.5 255", "-1 0", ""]))
        >>> read_ply_vertices(path, "x").tolist()
        [[0.5], [-1.0]]
    """
    source = Path(path)
    if not source.is_file():
        raise MissingFile(f"{caller}: no file {source}")
    with source.open("rb") as stream:
        start = stream.read(MOST_HEADER)
    try:
        header = parse_header(start)
        place = header.place
        vertex = header.elements[place]
        missing = [name for name in names if name not in (vertex.dtype.names or ())]
        if missing:
            raise InvalidFile(f"its vertices lack the properties {', '.join(missing)}")
        read = _binary_columns if header.order else _text_columns
        return read(source, header, place, names)
    except InvalidFile as error:
        raise InvalidFile(f"{caller}: {source} is not a PLY file that can be read: {error}") from None


def _binary_columns(source: Path, header: PlyHeader, place: int, names: Sequence[str]) -> NDArray[np.float64]:
    vertex = header.elements[place]
    body = source.stat().st_size - header.begins
    _check_length(body, [each.least_bytes for each in header.elements], header, "bytes")
    first = header.begins + sum(each.least_bytes for each in header.elements[:place])
    if not vertex.count:
        return np.zeros((0, len(names)))
    rows = np.memmap(source, vertex.dtype, "r", first, (vertex.count,))
    return np.stack([rows[name].astype(np.float64) for name in names], axis=1)


def _text_columns(source: Path, header: PlyHeader, place: int, names: Sequence[str]) -> NDArray[np.float64]:
    """Where the lines of the body end does not matter."""
    words = source.read_bytes()[header.begins :].split()
    widths = [len(each.dtype.names or ()) + (each.list_bytes > 0) for each in header.elements]
    counts = [each.count * width for each, width in zip(header.elements, widths)]
    _check_length(len(words), counts, header, "numbers")
    first = sum(counts[:place])
    chosen = words[first : first + counts[place]]
    try:
        if any(b"_" in word for word in chosen):  # float() takes 1_000
            raise ValueError
        table = np.array([float(word) for word in chosen], dtype=np.float64)
    except ValueError:
        raise InvalidFile("its vertices hold what is no number") from None
    fields = header.elements[place].dtype.names or ()
    return table.reshape(-1, len(fields))[:, [fields.index(name) for name in names]]


def _check_length(length: int, least: Sequence[int], header: PlyHeader, unit: str) -> None:
    excess = length - sum(least)
    if excess < 0 or (excess > 0 and not any(each.list_bytes for each in header.elements)):
        state = "longer" if excess > 0 else "shorter"
        told = ", ".join(f"{each.count} x {each.name}" for each in header.elements)
        raise InvalidFile(f"its body is {abs(excess)} {unit} {state} than its header says ({told})")
