"""Checks of payloads: sizes, stamps, numbers and rotations."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence

import numpy as np

from coview_stream.errors import MessageError
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Pose
from coview_stream.geometry.validation import MAX_COORDINATE
from coview_stream.messages.types import PoseMessage

MAX_PAYLOAD = 64 * 2**20
"""Largest payload that is decoded, bytes."""

MAX_POINTS = 4_000_000
"""Largest cloud that is decoded, points."""

_NANO = 1_000_000_000  # nanoseconds in a second


class RefusedError(MessageError):
    """The transport withheld a message, for one of a few reasons; counted as malformed."""


class OversizedError(MessageError):
    """A message exceeds the node's limits; counted separately from malformed ones."""


def check_size(payload: bytes, limit: int = MAX_PAYLOAD, size: int | None = None) -> None:
    """Raise OversizedError beyond ``limit`` bytes, or for ``size`` bytes that a transport left out."""
    if size is not None or len(payload) > limit:
        size = len(payload) if size is None else size
        raise OversizedError(f"{size} bytes; at most {limit} are taken: send fewer points or fields")


def stamp_from(value: object) -> int:
    """Return ``value`` if it is a whole number of nanoseconds in the int64 range, else raise MessageError."""
    if not isinstance(value, int) or isinstance(value, bool):
        raise MessageError(f"the stamp is of type {type(value).__name__}; write a whole number of nanoseconds")
    if not -(2**63) <= value < 2**63:
        raise MessageError("the stamp lies outside the int64 range: write nanoseconds")
    return value


def stamp_join(seconds: int, nanos: int) -> int:
    """Join seconds and ``nanos``, in [0, 1e9), into nanoseconds; MessageError if out of range."""
    if not 0 <= nanos < _NANO:
        raise MessageError(f"the stamp has {nanos} nanoseconds beside its seconds; they must be below 1e9")
    return stamp_from(seconds * _NANO + nanos)


def stamp_split(stamp_ns: int) -> tuple[int, int]:
    """Split a stamp into seconds and nanoseconds in [0, 1e9)."""
    return divmod(stamp_ns, _NANO)


def checked_pose(position: Sequence[float], quaternion: Sequence[float]) -> Pose:
    """Return the pose with x y z (metres) and qx qy qz qw; MessageError if not finite, too far, or not a rotation.

    The quaternion is normalised; its norm may be off by 1e-2 (float32 senders).
    """
    if not all(map(math.isfinite, (*position, *quaternion))):
        raise MessageError("the pose is not finite")
    if max(map(abs, position)) > MAX_COORDINATE:
        raise MessageError(f"the position lies more than {MAX_COORDINATE:.0e} m from its origin")
    norm = math.hypot(*quaternion)
    if abs(norm - 1.0) > 1e-2:
        raise MessageError(f"the orientation (qx, qy, qz, qw) has norm {norm:.3g}; a rotation has 1")
    x, y, z = position
    a, b, c, w = (part / norm for part in quaternion)
    # explicit: for 16 robots x 100 Hz of odometry, SciPy's 50 us per call would take a tenth of a core
    return np.array(
        (
            (1 - 2 * (b * b + c * c), 2 * (a * b - c * w), 2 * (a * c + b * w), x),
            (2 * (a * b + c * w), 1 - 2 * (a * a + c * c), 2 * (b * c - a * w), y),
            (2 * (a * c - b * w), 2 * (b * c + a * w), 1 - 2 * (a * a + b * b), z),
            (0.0, 0.0, 0.0, 1.0),
        )
    )


def read_attachment(attachment: bytes | None) -> tuple[int | None, int | None]:
    """Read stamp (ns) and sequence number from an attachment; None where absent or unknown.

    8 bytes: int64 LE ns. 33 bytes (rmw_zenoh): int64 LE number, int64 LE ns, 0x10 and 16 bytes of gid.
    """
    if attachment is not None and len(attachment) == 8:
        return int.from_bytes(attachment, "little", signed=True), None
    if attachment is not None and len(attachment) == 33 and attachment[16] == 16:
        sequence, stamp_ns = struct.unpack_from("<qq", attachment)
        return stamp_ns, sequence
    return None, None


def bare_pose(stamp_ns: int, T: Pose, frame_id: str, covariance: Floats | None = None) -> PoseMessage:
    """Return the message of a format that carries little more than a pose; missing fields are NaN or empty."""
    unknown = np.full((6, 6), np.nan) if covariance is None else covariance
    return PoseMessage(
        stamp_ns,
        "",
        state="TRACKING",
        T_map_body=T,
        covariance=unknown,
        confidence=math.nan,
        map_sha256="",
        age=math.nan,
        frame_id=frame_id,
    )
