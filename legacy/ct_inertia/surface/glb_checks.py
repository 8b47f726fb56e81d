"""What a GLB file claims, checked before a library allocates it."""

from __future__ import annotations

import json
import struct


def check_glb(content: bytes) -> None:
    """Refuse a GLB whose arrays are larger than the file.

    Parameters
    ----------
    content : bytes
        Of the file.

    Raises
    ------
    ValueError, KeyError, TypeError, struct.error, RecursionError
        Its first chunk is no JSON as glTF 2.0 describes it (section 4.4), or an array of it claims more
        elements than the file has bytes: arrays without a buffer are filled with zeros.
    """
    (length,) = struct.unpack_from("<I", content, 12)
    described = json.loads(content[20 : 20 + length])
    for part in (*described.get("buffers", ()), *described.get("bufferViews", ())):
        if not 0 <= part["byteLength"] <= len(content) or part.get("byteOffset", 0) < 0:
            raise ValueError(f"a buffer of {part['byteLength']} bytes in {len(content)}")
    for array in described.get("accessors", ()):
        if not 0 <= array["count"] <= len(content):
            raise ValueError(f"an array of {array['count']} elements in {len(content)} bytes")
        sparse = array.get("sparse", {}).get("count", 0)
        if not 0 <= sparse <= len(content):
            raise ValueError(f"a sparse array of {sparse} elements in {len(content)} bytes")
