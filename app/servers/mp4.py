"""Encoded pictures as an MP4 file with one H.264 track and fast start. Pure functions of bytes.

It has only the boxes of ISO/IEC 14496-12 and 14496-15 that players need.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from struct import pack

TIMESCALE = 600
"""ticks per second"""
_MATRIX = pack(">9I", 0x10000, 0, 0, 0, 0x10000, 0, 0, 0, 0x40000000)


@dataclass(frozen=True)
class Sample:
    """One encoded picture."""

    data: bytes
    key: bool  # it can be shown without earlier pictures


def mp4(samples: Sequence[Sample], description: bytes, size: tuple[int, int], rate: int) -> bytes:
    """The file of ordered pictures, `rate` per second; `description` is the codec's avcC."""
    head = _box("ftyp", b"isom", pack(">I", 512), b"isomiso2avc1mp41")
    # The track contains the offsets of its pictures, which depend on the track's length.
    length = len(_moov(samples, description, size, rate, 0))
    moov = _moov(samples, description, size, rate, len(head) + length + 8)
    return head + moov + _box("mdat", *(sample.data for sample in samples))


def _moov(
    samples: Sequence[Sample], description: bytes, size: tuple[int, int], rate: int, offset: int
) -> bytes:
    ticks = TIMESCALE // rate
    duration = ticks * len(samples)
    times = pack(">4I", 0, 0, TIMESCALE, duration)
    rest = pack(">IHH2I", 0x10000, 0x100, 0, 0, 0) + _MATRIX + bytes(24) + pack(">I", 2)
    return _box(
        "moov",
        _full("mvhd", 0, times, rest),
        _box(
            "trak",
            _full(
                "tkhd", 3, pack(">5I", 0, 0, 1, 0, duration), bytes(16), _MATRIX,
                pack(">2I", size[0] << 16, size[1] << 16),
            ),
            _box(
                "mdia",
                _full("mdhd", 0, times, pack(">HH", 0x55C4, 0)),  # language: undetermined
                _full("hdlr", 0, bytes(4), b"vide", bytes(12), b"film\0"),
                _box(
                    "minf",
                    _full("vmhd", 1, bytes(8)),
                    _box("dinf", _full("dref", 0, pack(">I", 1), _full("url ", 1))),
                    _table(samples, description, size, ticks, offset),
                ),
            ),
        ),
    )  # fmt: skip


def _table(
    samples: Sequence[Sample], description: bytes, size: tuple[int, int], ticks: int, offset: int
) -> bytes:
    """The sample table: format, duration, size and offset of the pictures."""
    keys = [number for number, sample in enumerate(samples, 1) if sample.key]
    sizes = [len(sample.data) for sample in samples]
    entry = _box(
        "avc1", bytes(6), pack(">H", 1), bytes(16), pack(">HH", *size),
        pack(">2I", 0x480000, 0x480000), bytes(4), pack(">H", 1), bytes(32), pack(">Hh", 24, -1),
        _box("avcC", description),
    )  # fmt: skip
    count = len(samples)
    return _box(
        "stbl",
        _full("stsd", 0, pack(">I", 1), entry),
        _full("stts", 0, pack(">3I", 1, count, ticks)),
        _full("stss", 0, pack(f">{len(keys) + 1}I", len(keys), *keys)),
        _full("stsc", 0, pack(">4I", 1, 1, count, 1)),
        _full("stsz", 0, pack(f">{count + 2}I", 0, count, *sizes)),
        _full("stco", 0, pack(">2I", 1, offset)),
    )


def _box(kind: str, *parts: bytes) -> bytes:
    content = b"".join(parts)
    return pack(">I", len(content) + 8) + kind.encode() + content


def _full(kind: str, flags: int, *parts: bytes) -> bytes:
    """A box with version 0 and flags."""
    return _box(kind, pack(">I", flags), *parts)
