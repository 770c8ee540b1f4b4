"""What the first bytes of a picture say of its size: asked before anything is decoded, since a header may lie.

The kinds known here are all that are decoded, whatever a file is called: decoders of rare kinds are where faults hide.

Sources: PNG (W3C, 11.2.1), JPEG (ITU-T T.81, B.2.2), WebP (RFC 9649), TIFF 6.0 and BigTIFF, BMP (as Windows has it),
Netpbm's PBM, PGM, PPM.
"""

import re
import struct

# Start-of-frame segments of JPEG: 0xC0 to 0xCF without tables (C4), the reserved one (C8) and arithmetic coding (CC).
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
# TIFF: tags of the width and the height, and how numbers of types 3 (short), 4 (long), 16 (long of BigTIFF) are read.
_TIFF_WIDTH, _TIFF_HEIGHT = 256, 257
_TIFF_NUMBERS = {3: "H", 4: "I", 16: "Q"}
# Entries of a TIFF's directory that are looked at; cameras write a few dozen.
_MOST_ENTRIES = 4096
_PNM = re.compile(rb"P[1-6](?:\s|#[^\n]*\n)+(\d{1,9})(?:\s|#[^\n]*\n)+(\d{1,9})\s")


def size(data: bytes) -> tuple[int, int] | None:
    """Return width and height that a picture states, None where it is of no kind known here or has no whole header."""
    try:
        if data.startswith(b"\x89PNG\r\n\x1a\n"):
            return struct.unpack_from(">II", data, 16)
        if data.startswith(b"\xff\xd8\xff"):
            return _jpeg(data)
        if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
            return _webp(data)
        if data[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
            return _tiff(data)
        if data.startswith(b"BM"):
            return _bmp(data)
        if found := _PNM.match(data):
            return int(found[1]), int(found[2])
    except (struct.error, OverflowError):
        pass
    return None


def _jpeg(data: bytes) -> tuple[int, int] | None:
    """Return the size in the first frame segment."""
    position = 2
    while position + 4 <= len(data) and data[position] == 0xFF:
        kind = data[position + 1]
        if kind == 0xFF:  # a fill byte
            position += 1
            continue
        if kind in _JPEG_FRAMES:
            height, width = struct.unpack_from(">HH", data, position + 5)
            return width, height
        position += 2 + int.from_bytes(data[position + 2 : position + 4], "big")
    return None


def _webp(data: bytes) -> tuple[int, int] | None:
    """Return the size in the first chunk: lossy, lossless, or extended, whose canvas every frame fits on."""
    kind, body = data[12:16], data[20:30]
    if kind == b"VP8X" and len(body) == 10:
        return 1 + int.from_bytes(body[4:7], "little"), 1 + int.from_bytes(body[7:10], "little")
    if kind == b"VP8L" and body[:1] == b"\x2f" and len(body) >= 5:
        bits = int.from_bytes(body[1:5], "little")
        return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    if kind == b"VP8 " and body[3:6] == b"\x9d\x01\x2a":
        width, height = struct.unpack_from("<HH", body, 6)
        return width & 0x3FFF, height & 0x3FFF
    return None


def _tiff(data: bytes) -> tuple[int, int] | None:
    """Return the size in the first directory."""
    order = "<" if data[:2] == b"II" else ">"
    if data[2:4] in (b"+\0", b"\0+"):
        (start,) = struct.unpack_from(f"{order}Q", data, 8)
        (count,) = struct.unpack_from(f"{order}Q", data, start)
        first, step, value_at = start + 8, 20, 12
    else:
        (start,) = struct.unpack_from(f"{order}I", data, 4)
        (count,) = struct.unpack_from(f"{order}H", data, start)
        first, step, value_at = start + 2, 12, 8
    found: dict[int, int] = {}
    for entry in range(first, first + step * min(count, _MOST_ENTRIES), step):
        tag, kind = struct.unpack_from(f"{order}HH", data, entry)
        if tag in (_TIFF_WIDTH, _TIFF_HEIGHT) and kind in _TIFF_NUMBERS:
            # Of a tag that is there twice, the larger: nobody knows which one the decoder takes.
            value = struct.unpack_from(f"{order}{_TIFF_NUMBERS[kind]}", data, entry + value_at)[0]
            found[tag] = max(value, found.get(tag, 0))
    return (found[_TIFF_WIDTH], found[_TIFF_HEIGHT]) if len(found) == 2 else None


def _bmp(data: bytes) -> tuple[int, int]:
    """Return the size; a negative height means that the rows run downwards."""
    (header,) = struct.unpack_from("<I", data, 14)
    if header == 12:
        return struct.unpack_from("<HH", data, 18)
    width, height = struct.unpack_from("<ii", data, 18)
    return abs(width), abs(height)
