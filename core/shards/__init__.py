"""Shards of cube pairs: how values are packed, and how files are written and read."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..lazy import attach

if TYPE_CHECKING:
    from .finding import expand_shards as expand_shards
    from .finding import find_shards as find_shards
    from .packing import dequantize_share as dequantize_share
    from .packing import dequantize_signed as dequantize_signed
    from .packing import pack_frame as pack_frame
    from .packing import pack_labels as pack_labels
    from .packing import quantize_share as quantize_share
    from .packing import quantize_signed as quantize_signed
    from .packing import unpack_labels as unpack_labels
    from .storage import ARRAYS as ARRAYS
    from .storage import OPTIONAL_ARRAYS as OPTIONAL_ARRAYS
    from .storage import SHARD_KINDS as SHARD_KINDS
    from .storage import SURROUNDINGS_RESOLUTION as SURROUNDINGS_RESOLUTION
    from .storage import TRANSMITTANCE_RESOLUTION as TRANSMITTANCE_RESOLUTION
    from .storage import Shard as Shard
    from .storage import ShardKind as ShardKind
    from .storage import read_shard as read_shard
    from .storage import stays_within as stays_within
    from .storage import write_shard as write_shard

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        ".finding": ["expand_shards", "find_shards"],
        ".packing": [
            "dequantize_share",
            "dequantize_signed",
            "pack_frame",
            "pack_labels",
            "quantize_share",
            "quantize_signed",
            "unpack_labels",
        ],
        ".storage": [
            "ARRAYS",
            "OPTIONAL_ARRAYS",
            "SHARD_KINDS",
            "SURROUNDINGS_RESOLUTION",
            "Shard",
            "ShardKind",
            "TRANSMITTANCE_RESOLUTION",
            "read_shard",
            "stays_within",
            "write_shard",
        ],
    },
)
