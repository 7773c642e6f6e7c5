"""Raw layouts for senders without a library, such as microcontrollers: little-endian float32 rows.

``xyz`` takes 12 bytes a point; ``xyzi`` takes 16, the fourth number (intensity) is skipped. The stamp is in the
attachment: :func:`coview_stream.messages.validation.read_attachment`.
"""

from __future__ import annotations

import numpy as np

from coview_stream.errors import MessageError
from coview_stream.geometry.arrays import Floats32
from coview_stream.messages.point_fields import Table, read_table
from coview_stream.messages.types import CloudMessage, Encoded, Sample
from coview_stream.messages.validation import read_attachment

_ENCODING = "application/octet-stream;layout="
_XYZ = (("x", "<f4", 0), ("y", "<f4", 4), ("z", "<f4", 8))


def _decode(sample: Sample, columns: int) -> CloudMessage:
    stamp_ns, _ = read_attachment(sample.attachment)
    if stamp_ns is None:
        raise MessageError("no stamp: a raw layout needs an attachment of 8 bytes, int64 little-endian nanoseconds")
    row = 4 * columns
    if len(sample.payload) % row:
        raise MessageError(f"{len(sample.payload)} bytes are no whole number of {row}-byte rows")
    table = Table(sample.payload, _XYZ, row, len(sample.payload) // row)
    return read_table(table, stamp_ns)


def _encode(message: CloudMessage, layout: str, rows: Floats32) -> Encoded:
    stamp = int(message.stamp_ns).to_bytes(8, "little", signed=True)
    return Encoded(rows.astype("<f4", copy=False).tobytes(), _ENCODING + layout, stamp)


def decode_xyz(sample: Sample) -> CloudMessage:
    """Read rows x, y, z; the points are a read-only view on the payload."""
    return _decode(sample, 3)


def decode_xyzi(sample: Sample) -> CloudMessage:
    """Read rows x, y, z, intensity; the intensity is skipped."""
    return _decode(sample, 4)


def encode_xyz(message: CloudMessage) -> Encoded:
    """Write the points; this layout carries no times, rings or sequence."""
    return _encode(message, "xyz", message.points)


def encode_xyzi(message: CloudMessage) -> Encoded:
    """Write the points with an intensity of zero."""
    rows = np.zeros((len(message.points), 4), np.float32)
    rows[:, :3] = message.points
    return _encode(message, "xyzi", rows)
