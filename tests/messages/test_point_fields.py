"""Clouds as drivers really lay them out: types, strides, byte orders, organised rows, times and rings."""

import numpy as np
import pytest
from codec_bytes import POINTS, STAMP, TURN, XYZ, cdr_cloud, pb_cloud, pb_pose
from hypothesis import given, settings
from hypothesis import strategies as st

from coview_stream import messages as codecs
from coview_stream.errors import MessageError
from coview_stream.messages.types import CloudMessage, Sample

ROS = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
FOXGLOVE = {"u1": 1, "i1": 2, "u2": 3, "i2": 4, "u4": 5, "i4": 6, "f4": 7, "f8": 8}
SECOND = 1_000_000_000


def rows_of(dtype, **columns):
    rows = np.zeros(len(POINTS), dtype)
    for axis, name in enumerate("xyz"):
        rows[name] = columns.pop(name, POINTS[:, axis])
    for name, values in columns.items():
        rows[name] = values
    return rows


def fields_of(rows, numbers):
    return [
        (name, rows.dtype.fields[name][1], numbers[rows.dtype[name].str[1:]])
        for name in rows.dtype.names
        if not name.startswith("_")
    ]


def read_ros(rows, **layout):
    payload = cdr_cloud(rows.tobytes(), fields_of(rows, ROS), rows.itemsize, len(rows), **layout)
    return codecs.decode_cloud(Sample("k", payload), option="cdr")


def read_foxglove(rows, **extra):
    payload = pb_cloud(rows.tobytes(), fields_of(rows, FOXGLOVE), rows.itemsize, **extra)
    return codecs.decode_cloud(Sample("k", payload), option="foxglove")


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("frame", ["", "os", "velodyne"])
def test_cdr_of_both_byte_orders_and_any_frame_name(order, frame):
    payload = cdr_cloud(POINTS.tobytes(), XYZ, 12, 2, order=order, frame=frame)
    for padding in range(4):
        read = codecs.decode_cloud(Sample("k", payload + bytes(padding)))
        np.testing.assert_array_equal(read.points, POINTS)
        assert read.stamp_ns == STAMP


@pytest.mark.parametrize("cdr_order", ["<", ">"])
def test_big_endian_point_data(cdr_order):
    rows = rows_of([("x", ">f4"), ("y", ">f4"), ("z", ">f4"), ("t", ">u4"), ("ring", ">u2")], t=[5, 10], ring=[1, 300])
    read = read_ros(rows, big=True, order=cdr_order)
    np.testing.assert_array_equal(read.points, POINTS)
    np.testing.assert_allclose(read.times, [5e-9, 1e-8], rtol=1e-12)
    assert read.rings.tolist() == [1, 300]


@pytest.mark.parametrize("read", [read_ros, read_foxglove])
@pytest.mark.parametrize(
    "dtype",
    [
        [("x", "<f8"), ("y", "<f8"), ("z", "<f8")],
        [("_", "V1"), ("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("_p", "V4"), ("intensity", "<f4"), ("_q", "V3")],
        [("z", "<f4"), ("intensity", "u1"), ("y", "<f8"), ("x", "<f4")],
        [("x", "<f4"), ("y", "<f4"), ("z", "<f8"), ("rgb", "<f4")],
    ],
)
def test_any_order_type_and_padding_of_fields(read, dtype):
    message = read(rows_of(dtype))
    np.testing.assert_array_equal(message.points, POINTS)
    assert message.points.dtype == np.float32
    assert message.points.flags.c_contiguous


@pytest.mark.parametrize("kind", ["i1", "<i2", "<i4"])
def test_whole_number_coordinates(kind):
    rows = rows_of([("x", kind), ("y", kind), ("z", kind)])
    np.testing.assert_array_equal(read_foxglove(rows).points, np.trunc(POINTS))


def test_organised_cloud_with_padded_rows():
    grid = np.arange(18, dtype="<f4").reshape(2, 3, 3)
    data = b"".join(row.tobytes() + b"\xff" * 5 for row in grid)[:-5]
    payload = cdr_cloud(data, XYZ, 12, 3, height=2, row_step=41)
    np.testing.assert_array_equal(codecs.decode_cloud(Sample("k", payload)).points, grid.reshape(-1, 3))


@pytest.mark.parametrize("row_step", [0, 1, 2**32 - 1])  # some drivers get it wrong
def test_row_step_of_a_single_row_is_ignored(row_step):
    payload = cdr_cloud(POINTS.tobytes(), XYZ, 12, 2, row_step=row_step)
    np.testing.assert_array_equal(codecs.decode_cloud(Sample("k", payload)).points, POINTS)


def test_non_finite_points_are_kept_and_float64_overflow_is_infinite():
    rows = rows_of([("x", "<f8"), ("y", "<f8"), ("z", "<f8")], x=[1e300, np.nan])
    points = read_ros(rows, dense=False).points
    assert np.isposinf(points[0, 0])
    assert np.isnan(points[1, 0])


@pytest.mark.filterwarnings("error")
def test_signalling_nan_and_infinity_raise_no_warnings():
    signal32, signal64 = (np.array([0x7FA00000], "<u4").view("<f4"), np.array([0x7FF4 << 48], "<u8").view("<f8"))
    dtype = [("x", "<f8"), ("y", "<f8"), ("z", "<f4"), ("time", "<f4"), ("ring", "<f4")]
    rows = np.zeros(3, dtype)
    rows["x"], rows["time"][1:], rows["ring"] = [1, np.inf, -np.inf], [np.inf, -np.inf], np.inf
    rows["y"][:1], rows["z"][:1], rows["time"][:1], rows["ring"][:1] = signal64, signal32, signal32, signal32
    for message in (read_ros(rows), read_foxglove(rows, pose=pb_pose((1, 2, 3), TURN))):
        assert not np.isfinite(message.points).all(axis=1).any()
        assert (message.times, message.rings) == (None, None)


@pytest.mark.parametrize("codec", ["xyz", "xyzi", "foxglove", "cdr", "keelson"])
def test_empty_cloud_is_decoded(codec):
    written = codecs.encode_cloud(CloudMessage(STAMP, np.zeros((0, 3), np.float32)), codec)
    read = codecs.decode_cloud(Sample("k", written.payload, written.encoding, written.attachment))
    assert read.points.shape == (0, 3)


TIMES = np.array([0.0, 0.0625])


@pytest.mark.parametrize("read", [read_ros, read_foxglove])
@pytest.mark.parametrize(
    ("name", "kind", "values"),
    [
        ("time", "<f4", TIMES),  # Velodyne
        ("t", "<u4", TIMES * SECOND),  # Ouster
        ("offset_time", "<u4", TIMES * SECOND),  # Livox
        ("t", "<i4", TIMES * SECOND),
        ("timestamp", "<f8", TIMES + STAMP / SECOND),  # Hesai, RoboSense
        ("timestamp", "<f8", TIMES * SECOND + STAMP),  # Livox driver 2
        ("time_offset", "<f8", TIMES),
    ],
)
def test_point_times_by_type_and_magnitude(read, name, kind, values):
    message = read(rows_of([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), (name, kind)], **{name: values}))
    assert message.times.dtype == np.float64
    np.testing.assert_allclose(message.times, TIMES, atol=5e-7)  # a float64 of seconds resolves 0.24 us


def test_stamp_at_end_of_sweep_gives_negative_point_times():
    rows = rows_of([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("timestamp", "<f8")], timestamp=STAMP / SECOND - TIMES)
    np.testing.assert_allclose(read_ros(rows).times, -TIMES, atol=5e-7)


@pytest.mark.parametrize(
    ("name", "kind", "values"),
    [
        ("time", "<f4", [0.0, 1.5]),  # farther than 1 s
        ("time", "<f4", [-0.9, 0.9]),  # longer than 1 s
        ("t", "<u4", [0, 2 * SECOND]),
        ("timestamp", "<f8", [1.0e9, 1.0e9]),  # another clock
        ("time", "<f4", [0.0, np.nan]),
        ("time", "<u2", [0, 1]),  # no driver writes that
    ],
)
def test_implausible_point_times_are_none(name, kind, values):
    message = read_ros(rows_of([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), (name, kind)], **{name: values}))
    assert message.times is None
    np.testing.assert_array_equal(message.points, POINTS)


def test_times_of_non_finite_points_are_ignored():
    dtype = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("timestamp", "<f8")]
    rows = rows_of(dtype, y=[np.nan, 1.0], timestamp=[0.0, STAMP / SECOND + 0.0625])
    np.testing.assert_allclose(read_ros(rows).times, [0.0, 0.0625], atol=5e-7)
    assert read_ros(rows_of(dtype, y=np.nan, timestamp=STAMP / SECOND)).times is None


@pytest.mark.parametrize("name", ["ring", "line", "channel"])
@pytest.mark.parametrize("kind", ["u1", "<u2", "<i4", "<f4"])
def test_ring_field_is_decoded(name, kind):
    rows = rows_of([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), (name, kind)], **{name: [3, 63]})
    rings = read_ros(rows).rings
    assert rings.dtype == np.uint16
    assert rings.tolist() == [3, 63]


@pytest.mark.parametrize(
    ("kind", "values"), [("<f4", [0.5, 1]), ("<f4", [np.nan, 1]), ("<i4", [-1, 1]), ("<u4", [70000, 1])]
)
def test_implausible_rings_are_none(kind, values):
    rows = rows_of([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("ring", kind)], ring=values)
    assert read_ros(rows).rings is None


def test_foxglove_cloud_pose_is_applied():
    rows = rows_of([("x", "<f4"), ("y", "<f4"), ("z", "<f4")])
    moved = read_foxglove(rows, pose=pb_pose((1, 2, 3), TURN)).points
    np.testing.assert_allclose(moved, POINTS[:, [2, 0, 1]] + [1, 2, 3], atol=1e-6)  # x to y, y to z, z to x
    assert moved.dtype == np.float32
    for identity in (b"", pb_pose((0, 0, 0), (0, 0, 0, 1))):
        np.testing.assert_array_equal(read_foxglove(rows, pose=identity).points, POINTS)
    with pytest.raises(MessageError, match="norm 0"):
        read_foxglove(rows, pose=pb_pose((0, 0, 1), (0, 0, 0, 0)))


@settings(max_examples=40, deadline=None)
@given(
    count=st.integers(0, 9),
    timed=st.booleans(),
    ringed=st.booleans(),
    seed=st.integers(0, 2**32 - 1),
    stamp=st.integers(-(2**31), 2**31 - 1),
)
@pytest.mark.parametrize("codec", ["foxglove", "cdr", "keelson"])
def test_clouds_with_times_and_rings_round_trip(codec, count, timed, ringed, seed, stamp):
    random = np.random.default_rng(seed)
    message = CloudMessage(
        stamp * SECOND + 7,
        random.normal(0, 30, (count, 3)).astype(np.float32),
        random.uniform(-0.4, 0.4, count) if timed else None,
        random.integers(0, 128, count).astype(np.uint16) if ringed else None,
    )
    written = codecs.encode_cloud(message, codec)
    read = codecs.decode_cloud(Sample("k", written.payload, written.encoding))
    assert read.stamp_ns == message.stamp_ns
    np.testing.assert_array_equal(read.points, message.points)
    if timed and count:
        np.testing.assert_allclose(read.times, message.times, atol=1e-7)
    else:
        assert read.times is None
    if ringed and count:
        np.testing.assert_array_equal(read.rings, message.rings)
    else:
        assert read.rings is None
