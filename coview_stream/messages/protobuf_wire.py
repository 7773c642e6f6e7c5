"""Protobuf wire format, one level deep: the bytes of a field, found without copies and with every size checked.

The schema classes would copy a cloud's data once more, and build an object for each of the millions of empty fields
that a hostile payload can announce.
"""

from __future__ import annotations

from dataclasses import dataclass

from coview_stream.errors import MessageError

_FIXED = {1: 8, 5: 4}
_LENGTH = 2


@dataclass(frozen=True)
class Entry:
    """One field on the wire; offsets in bytes from the start of the message.

    Attributes:
        number: of the field.
        sized: whether it has a length.
        start: offset of its tag.
        value: offset of its value, after the length.
        end: offset of what follows.
    """

    number: int
    sized: bool
    start: int
    value: int
    end: int


def entries(payload: bytes | memoryview, limit: int) -> list[Entry]:
    """List the top-level fields in order; MessageError if they overrun the payload or are more than ``limit``."""
    found: list[Entry] = []
    position = 0
    while position < len(payload):
        start = position
        tag, position = _varint(payload, position)
        kind = tag & 7
        value = position
        if kind == 0:
            _, position = _varint(payload, position)
        elif kind == _LENGTH:
            length, value = _varint(payload, position)
            position = value + length
        elif kind in _FIXED:
            position += _FIXED[kind]
        else:
            raise MessageError("the payload is no protobuf message")
        if position > len(payload) or tag < 8:
            raise MessageError("the protobuf message is truncated or malformed")
        found.append(Entry(tag >> 3, kind == _LENGTH, start, value, position))
        if len(found) > limit:
            raise MessageError(f"the protobuf message has more than {limit} fields")
    return found


def _varint(payload: bytes | memoryview, position: int) -> tuple[int, int]:
    value = 0
    for index, byte in enumerate(payload[position : position + 10]):
        value |= (byte & 127) << 7 * index
        if byte < 128:
            return value, position + index + 1
    raise MessageError("the protobuf message is truncated or malformed")


def split(payload: bytes | memoryview, number: int, limit: int) -> tuple[bytes, memoryview]:
    """Cut a message into all but the sized field ``number``, and a view on that field's last value."""
    view = memoryview(payload)
    rest: list[memoryview] = []
    value = view[:0]
    for entry in entries(view, limit):
        if entry.number == number and entry.sized:
            value = view[entry.value : entry.end]
        else:
            rest.append(view[entry.start : entry.end])
    return b"".join(rest), value


def sized_field(number: int, value: bytes) -> bytes:
    """Write a field of bytes or of a nested message."""
    return _packed(number << 3 | _LENGTH) + _packed(len(value)) + value


def _packed(value: int) -> bytes:
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    out.append(value)
    return bytes(out)


def timestamp(seconds: int, nanos: int) -> bytes:
    """Write a google.protobuf.Timestamp; varints are of 64 bits, negative ones in two's complement."""
    return b"\x08" + _packed(seconds % 2**64) + b"\x10" + _packed(nanos)
