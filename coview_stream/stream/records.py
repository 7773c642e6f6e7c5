"""Poses and statuses as plain JSON data, for whoever passes them on."""

from __future__ import annotations

import json
import math
from typing import Any, NoReturn

import numpy as np

from coview_stream.errors import MessageError
from coview_stream.geometry import pose_to_tum
from coview_stream.stream.messages import PoseMessage, Sample


def read_status(sample: Sample) -> dict[str, Any]:
    """Status of a node, a JSON object; no field of it is required.

    Raises:
        MessageError: it is none.
    """
    try:
        status = json.loads(sample.payload, parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        raise MessageError(f"{sample.key}: the status is no JSON ({error})") from error
    if not isinstance(status, dict):
        raise MessageError(f"{sample.key}: the status is no JSON object")
    return status


def pose_record(pose: PoseMessage, sample: Sample) -> dict[str, Any]:
    """Fields of a pose as in the native JSON, null where its format does not carry one.

    A sample that is JSON is given as it came, with whatever fields a newer node added.
    """
    if sample.payload[:1] == b"{":
        found: dict[str, Any] = json.loads(sample.payload)
        return found
    row = pose_to_tum(pose.T_map_body).tolist()
    return {
        "stamp_ns": pose.stamp_ns,
        "robot": pose.robot,
        "state": pose.state,
        "position": row[:3],
        "orientation": row[3:],
        "covariance": None if np.isnan(pose.covariance).any() else pose.covariance.ravel().tolist(),
        "confidence": _known(pose.confidence),
        "map_sha256": pose.map_sha256 or None,
        "age_s": _known(pose.age),
        "frame_id": pose.frame_id,
    }


def _known(value: float) -> float | None:
    return None if math.isnan(value) else value


def _no_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is no JSON number")
