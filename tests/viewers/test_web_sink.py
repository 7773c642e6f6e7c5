"""Events of the web page: poses, statuses from anyone, scans in the map frame, the map."""

import base64
import json
import struct

import numpy as np
import pytest

from coview_stream.basemap.summary import MapView
from coview_stream.geometry.protection import ProtectionLevel
from coview_stream.geometry.transforms import pose_from, rot_z
from coview_stream.messages.types import HypothesesMessage, PoseMessage
from coview_stream.viewers.scene import Scan
from coview_stream.viewers.web_sink import MAX_PAGES, WebHub, WebSink, encode_event, packed_map

EAST = 593_000.0


def events(taken):
    """Kinds and data of what a page takes."""
    lines = [block.split(b"\n") for block in taken.split(b"\n\n") if block]
    return [(kind[len(b"event: ") :].decode(), json.loads(data[len(b"data: ") :])) for kind, data in lines]


@pytest.fixture
def hub():
    return WebHub()


@pytest.fixture
def sink(hub):
    return WebSink(hub, hub.close)


@pytest.fixture
def page(hub, sink):
    return hub.open_page()


def pose(x, covariance=None, **fields):
    T = pose_from(rot_z(0.5), [EAST + x, -20.0, 3.0])
    return PoseMessage(
        10**18, "r1", "TRACKING", T, np.eye(6) if covariance is None else covariance, 0.999, "ab", **fields
    )


def test_a_pose_is_told_with_its_uncertainty(sink, page):
    covariance = np.diag([0.04, 0.01, 0.09, 1e-6, 1e-6, 1e-6])
    covariance[0, 1] = covariance[1, 0] = 0.01
    sink.pose(pose(0.25, covariance, protection=ProtectionLevel(0.5, 1.0, 0.4, 0.3)))
    ((kind, told),) = events(page.take(0.0))
    assert (kind, told["robot"], told["x"], told["yaw"]) == ("pose", "r1", EAST + 0.25, 0.5)
    assert told["cov"] == [0.04, 0.01, 0.01]
    assert told["sigma"][:3] == [0.2, 0.1, 0.3]
    assert told["protection"]["m"] == 0.5


def test_a_pose_without_uncertainty_is_told_too(sink, page):
    sink.pose(pose(0.0, np.full((6, 6), np.nan)))
    ((_, told),) = events(page.take(0.0))
    assert (told["cov"], told["sigma"], told["protection"]) == (None, None, None)


def test_a_page_that_opens_later_gets_the_trail(sink, hub):
    for x in (0.0, 0.1, 1.0, 1.1):
        sink.pose(pose(x))
    told = dict(events(hub.open_page().take(0.0)))
    assert told["trail"]["points"] == [[EAST, -20.0], [EAST + 1.0, -20.0]]


def test_a_status_from_anyone_is_cut_to_what_is_shown(sink, page):
    sink.status("r1", {
        "state": "LOST", "reason": "x" * 9999, "uptime_s": 10**400, "latency_ms": {"p50": 7.5, "p99": "fast"},
        "pose": [1], "counters": None, "calibration": {"says": ["leans", 3] + ["y"] * 99}, "errors": {"a": 1},
        "secret": "not told",
    })  # fmt: skip
    ((_, told),) = events(page.take(0.0))
    assert (told["state"], len(told["reason"]), told["uptime_s"]) == ("LOST", 500, None)
    assert (told["latency_ms"]["p50"], told["latency_ms"]["p99"]) == (7.5, "fast")
    assert (told["pose"], told["errors"], told["says"][0], len(told["says"])) == ({}, [], "leans", 7)
    assert "secret" not in told


def test_hypotheses_are_told(sink, page):
    sink.hypotheses(HypothesesMessage(10**18, "r1", np.array([[1.0, 2.0, 3.0, 0.5, 0.75, 9.0]]), 0.25, "ab"))
    ((_, told),) = events(page.take(0.0))
    assert told["places"] == [{"x": 1.0, "y": 2.0, "z": 3.0, "yaw": 0.5, "probability": 0.75}]
    assert told["none"] == 0.25


def test_a_scan_is_told_in_the_map_frame_where_its_pose_is_known(sink, page):
    points = np.array([[1.0, 0.0, 2.0]], dtype=np.float32)
    sink.scan(Scan("r1", 10**18, points, pose_from(rot_z(np.pi / 2), [EAST, 7.0, 1.0])))
    ((_, told),) = events(page.take(0.0))
    found = np.frombuffer(base64.b64decode(told["points"]), dtype="<i2") * told["step"]
    assert np.allclose(found, [0.0, 1.0, 2.0], atol=0.01)
    assert (told["in_map"], told["centre"]) == (True, [EAST, 7.0, 1.0])
    sink.scan(Scan("r1", 10**18, points, None))
    ((_, told),) = events(page.take(0.0))
    assert told["in_map"] is False


def test_the_map_is_packed_for_the_page(sink, page):
    points = np.array([[0.0, 0.0, 5.0], [10.0, 4.0, 0.0]], dtype=np.float32)
    view = MapView(np.array([EAST, 0.0, 0.0]), points, np.array([False, True]), "EPSG:25832", "ab")
    sink.map(view)
    sink.map(view)
    assert events(page.take(0.0)) == [("map", {"sha256": "ab", "count": 2})]
    packed = sink.maps["ab"]
    assert packed == packed_map(view)
    (length,) = struct.unpack("<I", packed[:4])
    header = json.loads(packed[4 : 4 + length])
    rows = np.frombuffer(packed[4 + length :], dtype="<i2").reshape(-1, 3) * header["step_m"] + header["origin"]
    assert np.allclose(rows, [[EAST + 10.0, 4.0, 0.0], [EAST, 0.0, 5.0]], atol=0.01)
    assert (length % 4, header["ground"]) == (0, 1)


def test_few_maps_are_kept(sink):
    for name in "abcdef":
        sink.map(MapView(np.zeros(3), np.zeros((1, 3), dtype=np.float32), np.array([True]), None, name))
    assert list(sink.maps) == list("cdef")


def test_what_a_page_has_not_taken_is_replaced_by_newer(hub, page):
    for k in range(10_000):
        hub.publish("pose", "r1", {"k": k})
        hub.publish("pose", "r2", {"k": -k})
    assert events(page.take(0.0)) == [("pose", {"k": 9999}), ("pose", {"k": -9999})]
    assert page.take(0.0) == b""


def test_a_new_page_is_told_what_is_kept(hub):
    hub.first = lambda: [encode_event("trail", {"points": []})]
    hub.publish("status", "r1", {"state": "LOST"})
    hub.publish("scan", "r1", {}, keep=False)
    assert events(hub.open_page().take(0.0)) == [("trail", {"points": []}), ("status", {"state": "LOST"})]


def test_names_from_the_network_fill_no_memory(hub, page):
    for k in range(20_000):
        hub.publish("pose", f"r{k}", {})
    assert len(events(page.take(0.0))) == 4000
    assert len(events(hub.open_page().take(0.0))) == 4000


def test_pages_are_limited_and_come_free(hub):
    pages = [hub.open_page() for _ in range(MAX_PAGES)]
    assert hub.open_page() is None
    hub.close_page(pages[0])
    assert hub.open_page() is not None
    hub.close()
    assert pages[1].closed
    assert pages[1].take(5.0) == b""  # at once
    assert hub.open_page() is None


def test_nan_is_no_event():
    with pytest.raises(ValueError, match="JSON"):
        encode_event("pose", {"x": float("nan")})
