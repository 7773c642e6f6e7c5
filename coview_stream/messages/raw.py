"""Raw layouts for senders without a library, such as microcontrollers: little-endian float32 rows.

``xyz`` takes 12 bytes a point, ``xyzi`` 16, of which the fourth number (intensity) is skipped. The stamp is in the
attachment: :func:`coview_stream.messages.validation.read_attachment`.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from coview_stream.errors import MessageError
from coview_stream.messages.point_fields import Table, read_table
from coview_stream.messages.types import CloudMessage, Encoded, Sample
from coview_stream.messages.validation import read_attachment

_ENCODING = "application/octet-stream;layout="
_XYZ = (("x", "<f4", 0), ("y", "<f4", 4), ("z", "<f4", 8))


def _decode(sample: Sample, columns: int) -> CloudMessage:
    """Read rows of numbers; the points are a read-only view of the payload."""
    stamp_ns, _ = read_attachment(sample.attachment)
    if stamp_ns is None:
        raise MessageError("no stamp: a raw layout needs an attachment of 8 bytes, int64 little-endian nanoseconds")
    row = 4 * columns
    if len(sample.payload) % row:
        raise MessageError(f"{len(sample.payload)} bytes are not a whole number of {row}-byte rows")
    return read_table(Table(sample.payload, _XYZ, row, len(sample.payload) // row), stamp_ns)


def _encode(message: CloudMessage, columns: int) -> Encoded:
    """Write the points; these layouts carry no times, rings or sequence."""
    rows = np.zeros((len(message.points), columns), "<f4")
    rows[:, :3] = message.points
    stamp = int(message.stamp_ns).to_bytes(8, "little", signed=True)
    return Encoded(rows.tobytes(), _ENCODING + "xyzi"[:columns], stamp)


decode_xyz, encode_xyz = partial(_decode, columns=3), partial(_encode, columns=3)
decode_xyzi, encode_xyzi = partial(_decode, columns=4), partial(_encode, columns=4)
