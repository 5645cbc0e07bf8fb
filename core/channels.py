"""What a denoiser may see of a cube, channel by channel: names, values, what stands for "unknown".

    signed_opacity   (32^3)  the cube itself: -1 is empty, +1 is opaque; always known, always first
    surroundings     (16^3)  signed opacity about the same centre at three times the edge: its mean over each voxel
    view_count       (32^3)  how many training views have a voxel in their frustum
    transmittance    (16^3)  the largest share of light that one of them gets from there, through the field itself

Optional channels (all but the first) hold known values in [-1/2, 1]; -1, which no known value comes near, says that
the caller could not tell. Every channel has the cube's shape, so that ``channels (N, C, 32, 32, 32)`` is one array:
each voxel of 16^3 is repeated 2 x 2 x 2 times, which :func:`coarse_channel` undoes exactly.

Along an axis, in edges of the cube. A voxel of the surroundings is six of the cube's wide, and 5 1/3 of them cover
the cube: the two grids do not line up, hence :func:`coincident_weights`.

    -1.5               -.5                .5               1.5
      | . . . . . . . . | . . . . . . . . | . . . . . . . . |    surroundings
                        |.................|                      cube
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from .arrays import Array, namespace
from .errors import InvalidArgument
from .frames import RESOLUTION, cube_lattices
from .occupancy import EMPTY, OCCUPIED
from .shards.storage import MAX_VIEW_COUNT, SURROUNDINGS_EDGE, SURROUNDINGS_RESOLUTION

Float32 = NDArray[np.float32]

SIGNED_OPACITY, SURROUNDINGS, VIEW_COUNT = "signed_opacity", "surroundings", "view_count"
TRANSMITTANCE = "transmittance"
SUPPORT, CROSSINGS = "support", "crossings"
CHANNEL_NAMES = (SIGNED_OPACITY, SURROUNDINGS, VIEW_COUNT, TRANSMITTANCE, SUPPORT, CROSSINGS)
OPTIONAL_CHANNELS = CHANNEL_NAMES[1:]
UNKNOWN = -1.0
LEAST_KNOWN = -0.5  # of an optional channel: an empty voxel, no view
POOLED = 2  # points along an axis of each voxel of the surroundings
REPEAT = RESOLUTION // SURROUNDINGS_RESOLUTION
EVIDENCE_GAIN, EVIDENCE_BITS = 8.0, 8.0  # a typical cell (1) is stored as .4; 32 times that as 1


def check_channels(names: Sequence[str], *, caller: str) -> tuple[str, ...]:
    """The names as a tuple.

    Raises:
        ValueError: an unknown or repeated name, or another first one than ``signed_opacity``.
    """
    given = tuple(names)
    if not given or given[0] != SIGNED_OPACITY or not set(given) <= set(CHANNEL_NAMES) or len(set(given)) < len(given):
        raise InvalidArgument(
            f"{caller}: channels must start with {SIGNED_OPACITY!r} and be among {CHANNEL_NAMES}, each once, "
            f"got {given}"
        )
    return given


def encode_surroundings(signed: NDArray[np.floating]) -> Float32:
    """Mean signed opacity ``(...)`` in [-1, 1] to the channel's values in [-1/2, 1]."""
    return encode_share((np.asarray(signed, dtype=np.float32) - np.float32(EMPTY)) / np.float32(OCCUPIED - EMPTY))


def encode_view_count(counts: NDArray[np.integer]) -> Float32:
    """Numbers of views ``(...)`` to the channel's values: ``-1/2 + 3/2 log2(1 + min(n, 255)) / 8``.

    Strictly increasing up to 255 views (value 1), constant from there; doubling the views adds about the same
    anywhere, because the step from none to one tells more than that from 30 to 31.
    """
    capped = np.minimum(np.asarray(counts), MAX_VIEW_COUNT).astype(np.float32)
    share = np.log2(np.float32(1.0) + capped) / np.float32(math.log2(1.0 + MAX_VIEW_COUNT))
    return encode_share(share)


def evidence_share(relative: NDArray[np.floating]) -> Float32:
    """Relative support or crossings ``(...)`` >= 0 to shares in [0, 1]: ``log2(1 + 8 min(r, 31.875)) / 8``.

    Args:
        relative: 1 in a typical cell that has any (:meth:`unghost.core.sight_lines.SightLines.support`).
    """
    most = (2.0**EVIDENCE_BITS - 1.0) / EVIDENCE_GAIN
    capped = np.minimum(np.asarray(relative, dtype=np.float32), np.float32(most))
    share: Float32 = np.log2(np.float32(1.0) + np.float32(EVIDENCE_GAIN) * capped) / np.float32(EVIDENCE_BITS)
    return share


def encode_share(share: NDArray[np.floating]) -> Float32:
    """Shares ``(...)`` in [0, 1], of light for ``transmittance``, to an optional channel's values in [-1/2, 1]."""
    encoded: Float32 = np.float32(LEAST_KNOWN) + np.float32(1.0 - LEAST_KNOWN) * np.asarray(share, dtype=np.float32)
    return encoded


def full_channel(coarse: NDArray[np.floating]) -> Float32:
    """Surroundings or transmittances ``(..., 16, 16, 16)`` as a channel ``(..., 32, 32, 32)``: each 2 x 2 x 2 times."""
    grown = np.asarray(coarse, dtype=np.float32)
    for axis in (-3, -2, -1):
        grown = np.repeat(grown, REPEAT, axis=axis)
    return grown


def coarse_channel(channel: NDArray[np.floating]) -> Float32:
    """Inverse of :func:`full_channel`: ``(..., 32, 32, 32)`` to ``(..., 16, 16, 16)``."""
    taken: Float32 = np.asarray(channel, dtype=np.float32)[..., ::REPEAT, ::REPEAT, ::REPEAT]
    return taken


def encode_known(
    *,
    surroundings: NDArray[np.floating] | None = None,
    view_count: NDArray[np.integer] | None = None,
    transmittance: NDArray[np.floating] | None = None,
    support: NDArray[np.floating] | None = None,
    crossings: NDArray[np.floating] | None = None,
) -> dict[str, Float32]:
    """The optional channels that are known, encoded, by name.

    Args:
        surroundings: ``(N, 16, 16, 16)`` mean signed opacity.
        view_count: ``(N, 32, 32, 32)``.
        transmittance: ``(N, 16, 16, 16)`` shares of light.
        support, crossings: ``(N, 32, 32, 32)`` shares of :func:`evidence_share`.
    """
    known: dict[str, Float32] = {}
    if surroundings is not None:
        known[SURROUNDINGS] = encode_surroundings(surroundings)
    if view_count is not None:
        known[VIEW_COUNT] = encode_view_count(view_count)
    if transmittance is not None:
        known[TRANSMITTANCE] = encode_share(transmittance)
    if support is not None:
        known[SUPPORT] = encode_share(support)
    if crossings is not None:
        known[CROSSINGS] = encode_share(crossings)
    return known


def stack_channels(names: Sequence[str], signed: NDArray[np.floating], known: Mapping[str, Float32]) -> Float32:
    """Put the channels that a denoiser asks for together; those that are not known say so.

    Args:
        names: of the channels, in order.
        signed: ``(N, R, R, R)`` signed opacity.
        known: name to encoded values ``(N, R, R, R)``, or ``(N, 16, 16, 16)``; others are ignored.

    Returns:
        ``(N, C, R, R, R)`` float32 in [-1, 1].
    """
    wanted = check_channels(names, caller="stack_channels")
    stacked = np.full((len(signed), len(wanted), *signed.shape[1:]), UNKNOWN, dtype=np.float32)
    stacked[:, 0] = signed
    for index, name in enumerate(wanted):
        if index and name in known:
            values = known[name]
            stacked[:, index] = full_channel(values) if values.shape[1:] != signed.shape[1:] else values
    return stacked


def with_unknown(channels: Array, count: int) -> Array:
    """Cubes of which only the first channel is given ``(N, 1, R, R, R)`` with ``count - 1`` unknown ones behind it.

    Args:
        channels: array or tensor; of any other number of channels it is returned as it is.
        count: channels that a denoiser takes.
    """
    if count == 1 or len(channels.shape) != 5 or channels.shape[1] != 1:
        return channels
    xp, shape = namespace(channels), (channels.shape[0], count - 1, *channels.shape[2:])
    unknown = xp.full_like(channels[:, :1], UNKNOWN)
    return xp.concatenate([channels, xp.broadcast_to(unknown, shape)], 1)


def surroundings_lattice(
    centers: NDArray[np.floating], edges: NDArray[np.floating], rotations: NDArray[np.floating] | None = None
) -> NDArray[np.float64]:
    """Where to ask for the surroundings of some cubes: ``(N, 32, 32, 32, 3)``, 2 x 2 x 2 points a voxel.

    Such a voxel is six of the cube's wide, several cells of the field, so that one point would miss a surface
    or take it for the whole voxel.

    Args:
        centers, edges, rotations: ``(N, 3)``, ``(N,)``, ``(N, 3, 3)`` of the cubes (not of their surroundings).
    """
    return cube_lattices(
        centers, SURROUNDINGS_EDGE * np.asarray(edges), rotations, resolution=POOLED * SURROUNDINGS_RESOLUTION
    )


def pool_surroundings(signed: Float32) -> Float32:
    """Signed opacity at the points of :func:`surroundings_lattice` to its means ``(N, 16, 16, 16)``."""
    coarse = SURROUNDINGS_RESOLUTION
    blocks = signed.reshape(len(signed), coarse, POOLED, coarse, POOLED, coarse, POOLED)
    pooled: Float32 = blocks.mean(axis=(2, 4, 6))
    return pooled


def coincident_weights(source: int, target: int) -> tuple[slice, Float32]:
    """Linear interpolation from a grid over the surroundings to a grid over the cube, along one axis.

    Args:
        source: voxels along the surroundings (three edges), of which some lie about the cube.
        target: voxels along the cube.

    Returns:
        the voxels that matter (a slice of ``source``, symmetric about the middle), and their weights
        ``(target, those)`` float32, whose rows sum to 1.
    """
    centers = SURROUNDINGS_EDGE * ((np.arange(source) + 0.5) / source - 0.5)
    wanted = (np.arange(target) + 0.5) / target - 0.5
    distance = np.abs(wanted[:, None] - centers) / (SURROUNDINGS_EDGE / source)
    weights = np.maximum(1.0 - distance, 0.0)
    used = np.flatnonzero(weights.any(axis=0))
    part = slice(int(used[0]), int(used[-1]) + 1)
    return part, weights[:, part].astype(np.float32)
