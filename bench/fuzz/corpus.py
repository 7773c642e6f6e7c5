"""Seeds for the fuzzing, small and whole: ``python -m bench.fuzz.corpus [DIR]``; what was found is kept beside them."""

from __future__ import annotations

import json
import sys
import tempfile
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from bench.fuzz.fuzz import CORPUS
from coview_stream import messages
from coview_stream.basemap import file_format
from coview_stream.clouds import write_cloud
from coview_stream.config import DescriptorConfig, MapConfig
from coview_stream.messages.types import CloudMessage, OdometryMessage
from coview_stream.messages.validation import bare_pose
from coview_stream.stream.node import last_pose

_STAMP = 1_700_000_000_123_456_789
_POINTS = np.random.default_rng(2).normal(0, 20, (40, 3)).astype(np.float32)
_PLY = """ply
format {order} 1.0
comment two lists before the vertices
element face 2
property list uchar int indices
property list short float weights
element vertex {n}
property float x
property float y
property float z
property uchar red
end_header
"""


def _message_seeds() -> dict[str, list[bytes]]:
    cloud = CloudMessage(_STAMP, _POINTS, np.linspace(0.0, 0.1, len(_POINTS)))
    bare = CloudMessage(_STAMP, _POINTS)
    odometry = OdometryMessage(_STAMP, np.eye(4))
    pose = replace(bare_pose(_STAMP, np.eye(4), "map", np.eye(6)), confidence=0.9, age=0.1)
    seeds: dict[str, list[bytes]] = {}
    for codec in messages.CLOUD_CODECS:
        seeds[f"cloud-{codec}"] = [
            _sample(messages.encode_cloud(each, codec)) for each in (bare, cloud) if each is bare or "xyz" not in codec
        ]
    for codec in messages.ODOMETRY_CODECS:
        seeds[f"odometry-{codec}"] = [_sample(messages.encode_odometry(odometry, codec))]
    for codec in messages.POSE_CODECS:
        seeds[f"pose-{codec}"] = [_sample(messages.encode_pose(pose, codec))]
    seeds["encoding"] = [
        b"%s\n%s\n%s" % (each.encoding.encode(), key, each.payload)
        for each, key in (
            (messages.encode_cloud(bare, "cdr"), b"coview/r1/cloud"),
            (messages.encode_cloud(bare, "foxglove"), b"coview/r1/cloud"),
            (messages.encode_odometry(odometry, "json"), b"coview/r1/odometry"),
            (messages.encode_odometry(odometry, "cdr"), b"0/odom/nav_msgs::msg::dds_::Odometry_/RIHS01_00"),
            (messages.encode_pose(pose, "keelson"), b"a/@v0/b/pubsub/location_fix/c"),
        )
    ]
    return seeds


def _sample(encoded: messages.Encoded) -> bytes:
    beside = encoded.attachment or b""
    return bytes([len(beside)]) + beside + encoded.payload


def _cloud_seeds(folder: Path) -> dict[str, list[bytes]]:
    seeds: dict[str, list[bytes]] = {}
    for suffix in ("las", "laz", "ply", "pcd", "npy", "bin"):
        write_cloud(folder / f"a.{suffix}", _POINTS)
        seeds[suffix] = [(folder / f"a.{suffix}").read_bytes()]
    rows = b"".join(point.tobytes() + b"\7" for point in _POINTS[:5])
    lists = (b"\3" + bytes(12) + b"\1\0" + bytes(4)) + (b"\4" + bytes(16) + b"\2\0" + bytes(8))
    seeds["ply"].append(_PLY.format(order="binary_little_endian", n=5).encode() + lists + rows)
    text = "3 0 1 2 1 0.5\n4 0 1 2 3 2 0.5 1\n" + "".join(f"{x} {y} {z} 7\n" for x, y, z in _POINTS[:5])
    seeds["ply"].append((_PLY.format(order="ascii", n=5) + text).encode())
    head = (
        "VERSION 0.7\nFIELDS x y z i\nSIZE 4 4 4 2\nTYPE F F F U\nCOUNT 1 1 1 2\nWIDTH 4\nHEIGHT 1\nPOINTS 4\nDATA {}\n"
    )
    seeds["pcd"].append((head.format("ascii") + "1 2 3 4 5\n" * 4).encode())
    packed = b"\2\0\0\x80" + b"\xe0\x34\2"
    size = 3 + 0x34 + 9
    seeds["pcd"].append(head.format("binary_compressed").encode() + _words(len(packed), size) + packed)
    return seeds


def _words(*values: int) -> bytes:
    return b"".join(value.to_bytes(4, "little") for value in values)


def _map_seed(folder: Path) -> bytes:
    config = MapConfig(DescriptorConfig(rings=4, sectors=8), learned=False)
    rng = np.random.default_rng(1)
    arrays: file_format.Arrays = {
        "origin": np.array([5e5, 5.4e6, 300.0]),
        "stations": rng.normal(size=(3, 3)).astype(np.float32),
        "points": rng.normal(size=(20, 3)).astype(np.float32),
        "normals": rng.integers(-127, 128, (20, 3)).astype(np.int8),
        "tile_index": np.array([[0, 0, 0, 20]]),
        "surveyed": np.ones((3, 5), np.uint8),
        "surveyed_corner": np.zeros(2),
    } | {f"descriptor.{name}": np.ones((3, 4, 8), np.float16) for name in config.descriptor.channels}
    parameters = {"config": asdict(config), "crs": None, "sources": {"a.laz": "00ff"}}
    file_format.save(folder / "a.coview", arrays, json.loads(json.dumps(parameters)))
    return (folder / "a.coview").read_bytes()


def _bag_seeds(folder: Path) -> dict[str, list[bytes]]:
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    seeds: dict[str, list[bytes]] = {}
    for suffix, plugin in (("mcap", StoragePlugin.MCAP), ("db3", StoragePlugin.SQLITE3)):
        with Writer(folder / suffix, version=9, storage_plugin=plugin) as writer:
            kinds = {"/points": "sensor_msgs/msg/PointCloud2", "/odom": "nav_msgs/msg/Odometry"}
            topics = {topic: writer.add_connection(topic, kind, typestore=store) for topic, kind in kinds.items()}
            for k in range(2):
                stamp = _STAMP + k * 10**8
                cloud = messages.encode_cloud(CloudMessage(stamp, _POINTS[:8]), "cdr")
                odometry = messages.encode_odometry(OdometryMessage(stamp, np.eye(4)), "cdr")
                writer.write(topics["/points"], stamp, cloud.payload)
                writer.write(topics["/odom"], stamp, odometry.payload)
        (file,) = (folder / suffix).glob(f"*.{suffix}")
        seeds[suffix] = [file.read_bytes()]
    return seeds | {"bag": [_ros1(folder)]}


def _ros1(folder: Path) -> bytes:
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store, old = get_typestore(Stores.ROS2_HUMBLE), get_typestore(Stores.ROS1_NOETIC)
    kind = "sensor_msgs/msg/PointCloud2"
    with Writer(folder / "a.bag") as writer:
        topic = writer.add_connection("/points", kind, typestore=old)
        cloud = messages.encode_cloud(CloudMessage(_STAMP, _POINTS[:8]), "cdr").payload
        writer.write(topic, _STAMP, bytes(store.cdr_to_ros1(cloud, kind)))
    return (folder / "a.bag").read_bytes()


def seeds() -> dict[str, list[bytes]]:
    """Return the seeds of every target."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        known = last_pose.LastPose("r1", "0" * 64, _STAMP, np.eye(4))
        tum = b"# t x y z qx qy qz qw\n1.0 1 2 3 0 0 0 1\n2.0 1 2 3 0 0 0 1\n"
        return (
            _message_seeds()
            | _cloud_seeds(folder)
            | _bag_seeds(folder)
            | {
                "map": [_map_seed(folder)],
                "state": [last_pose.save(folder, known).read_bytes()],
                "trajectory": [b"\0" + tum, b"\1" + b"1 0 0 1 0 1 0 2 0 0 1 3\n" * 2, b"\2" + b"0.1\n0.2\n"],
                "rpc": [
                    b"seconds=1;x",
                    b'{"state": "TRACKING", "robot": "r1", "reason": "", "counters": {"frames": 3}}',
                    b'{"state": "LOST", "node": {"id": "a", "term": 1, "period_s": 1.0, "ending": false}}',
                ],
            }
        )


def hostile() -> dict[str, dict[str, bytes]]:
    """Return what once aborted, took gigabytes, never ended or raised anything: by target and what it does."""
    whole = {name: contents[0] for name, contents in seeds().items()}
    laz, points = whole["laz"], int.from_bytes(whole["laz"][96:100], "little")
    chunk = laz.index(b"laszip encoded") - 2 + 54 + 12
    layer = points + 8 + 30 + 4
    faces = "ply\nformat binary_little_endian 1.0\nelement face {}\nproperty list {} int i\nelement vertex 1\n"
    axes = "property float x\nproperty float y\nproperty float z\nend_header\n"
    pcd = "VERSION 0.7\nFIELDS x y z i\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 {}\nWIDTH 1\nPOINTS 1\nDATA {}\n"
    metadata = {"format": file_format.FORMAT, "version": str(file_format.VERSION), "sha256": ""}
    infinite = {"dtype": "U8", "shape": [float("inf")], "data_offsets": [0, 8]}
    return {
        "laz": {
            "chunk-size": laz[:chunk] + _words(0x84000000) + laz[chunk + 4 :],
            "layer-size": laz[:layer] + _words(0xF0000000) + laz[layer + 4 :],
        },
        "ply": {
            "endless-list": (faces.format(10**12, "int") + axes).encode() + b"\xff" * 64,
            "float-length": (faces.format(1, "float") + axes).encode() + b"\0\0\xc0\x7f" + bytes(64),
            "named-twice": (faces.format(1, "uchar") + "property float x\n" + axes).encode() + bytes(64),
        },
        "pcd": {
            "count": (pcd.format(10**30, "binary")).encode() + bytes(16),
            "unpacks": pcd.format(1, "binary_compressed").encode() + _words(64, 0xFFFFFFFF) + bytes(64),
        },
        "map": {
            "brackets": _header(b"[" * 9000),
            "null": _header(json.dumps({"__metadata__": metadata | {"parameters": None}}).encode()),
            "infinite": _header(json.dumps({"__metadata__": metadata | {"parameters": "{}"}, "a": infinite}).encode()),
        },
    }


def _header(text: bytes) -> bytes:
    return len(text).to_bytes(8, "little") + text + bytes(16)


def main(folder: Path) -> None:
    """Write them."""
    for name, contents in seeds().items():
        (folder / name).mkdir(parents=True, exist_ok=True)
        for number, content in enumerate(contents):
            (folder / name / f"seed-{number}").write_bytes(content)
    for name, known in hostile().items():
        for what, content in known.items():
            (folder / name / f"known-{what}").write_bytes(content)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else CORPUS)
