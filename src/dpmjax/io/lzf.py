"""LZF, the compression of PCD files: runs of literal bytes and copies of earlier bytes."""

from __future__ import annotations

MOST_EXPANSION = 88
"""Three packed bytes unpack to 264 at most."""


def unpack_lzf(packed: bytes, size: int) -> bytes:
    """Unpacks a block of LZF.

    A control byte below 32 begins a run of that many literal bytes and one more. Any other begins a copy. Its upper
    three bits are the length less two; 7 adds the next byte. Its lower five bits and the next byte are the distance
    less one.

    Args:
        packed: the block.
        size: number of bytes that it holds.

    Returns:
        The bytes.

    Raises:
        ValueError: the block is damaged, or holds another number of bytes.
        IndexError: the block ends within a copy.
    """
    out, at, end = bytearray(), 0, len(packed)
    while at < end and len(out) <= size:
        control = packed[at]
        at += 1
        if control < 32:
            out += packed[at : at + control + 1]
            at += control + 1
            continue
        length = control >> 5
        if length == 7:
            length += packed[at]
            at += 1
        start = len(out) - ((control & 31) << 8) - packed[at] - 1
        at, length = at + 1, length + 2
        if start < 0:
            raise ValueError(f"a copy of bytes before the first one, at byte {at}")
        piece = out[start : start + length]
        out += piece if len(piece) == length else (piece * (length // len(piece) + 1))[:length]
    if at != end or len(out) != size:
        raise ValueError(f"unpacks to {len(out)} bytes, not to {size}")
    return bytes(out)
