"""CDR and protobuf composed by hand, so that the codecs are not tested against themselves."""

import struct

import numpy as np

STAMP = 1_700_000_000_123_456_789
SECONDS, NANOS = 1_700_000_000, 123_456_789
TURN = (0.5, 0.5, 0.5, 0.5)  # x to y, y to z, z to x: exact in any arithmetic
T_TURN = np.array([[0.0, 0, 1, 1], [1, 0, 0, 2], [0, 1, 0, 3], [0, 0, 0, 1]])
POINTS = np.array([[1.0, 2.0, 3.0], [-4.0, 5.5, -6.25]], np.float32)


class Cdr:
    """Primitive values one after another, each aligned to its own size, after the encapsulation header."""

    def __init__(self, order="<"):
        self.order = order
        self.body = bytearray()

    def put(self, kind, *values):
        for value in values:
            self.body += bytes(-len(self.body) % struct.calcsize(kind))
            self.body += struct.pack(self.order + kind, value)
        return self

    def text(self, value):
        raw = value.encode() + b"\0"
        self.put("I", len(raw))
        self.body += raw
        return self

    def data(self, raw):
        self.put("I", len(raw))
        self.body += raw
        return self

    def done(self):
        return (b"\0\1\0\0" if self.order == "<" else b"\0\0\0\0") + bytes(self.body)


def header(order="<", frame="base_link", seconds=SECONDS, nanos=NANOS):
    return Cdr(order).put("i", seconds).put("I", nanos).text(frame)


def cdr_cloud(
    data, fields, step, width, height=1, row_step=None, order="<", big=False, dense=True, frame="base_link", nanos=NANOS
):
    """PointCloud2 from (name, offset, datatype) and its rows."""
    out = header(order, frame, nanos=nanos).put("I", height, width, len(fields))
    for name, offset, datatype in fields:
        out.text(name).put("I", offset).put("B", datatype).put("I", 1)
    out.put("B", big).put("I", step, step * width if row_step is None else row_step)
    return out.data(data).put("B", dense).done()


def cdr_pose(covariance=(0.0,) * 36):
    return header(frame="map").put("d", 1, 2, 3, *TURN, *covariance)


def cdr_odometry(order="<", quaternion=TURN, position=(1, 2, 3)):
    out = header(order, "odom").text("base_link").put("d", *position)
    return out.put("d", *quaternion).put("d", *(0.0,) * 36).put("d", *(0.0,) * 42).done()


XYZ = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7)]


def varint(value):
    out = b""
    while value >= 128:
        out += bytes([value % 128 + 128])
        value //= 128
    return out + bytes([value])


def sized(number, value):
    return varint(number * 8 + 2) + varint(len(value)) + value


def stamp(seconds=SECONDS, nanos=NANOS):
    return sized(1, b"\x08" + varint(seconds % 2**64) + b"\x10" + varint(nanos % 2**64))


def doubles(*values):
    return b"".join(bytes([8 * number + 1]) + struct.pack("<d", v) for number, v in enumerate(values, 1) if v)


def pb_pose(position=(1, 2, 3), quaternion=TURN):
    return sized(1, doubles(*position)) + sized(2, doubles(*quaternion))


def pb_in_frame(frame="odom", **pose):
    return stamp() + sized(2, frame.encode()) + sized(3, pb_pose(**pose))


def pb_transform(parent="odom", child="base_link"):
    rotation = sized(5, doubles(*TURN))
    return stamp() + sized(2, parent.encode()) + sized(3, child.encode()) + sized(4, doubles(1, 2, 3)) + rotation


def pb_cloud(data, fields, step, pose=None, head=None):
    """foxglove.PointCloud from (name, offset, type) and its rows."""
    out = stamp() if head is None else head
    out += sized(2, b"base_link")
    if pose is not None:
        out += sized(3, pose)
    out += b"\x25" + struct.pack("<I", step)
    for name, offset, kind in fields:
        at = b"\x15" + struct.pack("<I", offset) if offset else b""
        out += sized(5, sized(1, name.encode()) + at + b"\x18" + varint(kind))
    return out + sized(6, data)


def envelope(payload):
    return stamp() + sized(2, payload)
