"""Files made to cost: whatever a header claims, reading takes bounded time and memory and ends in one CloudError."""

import struct

import numpy as np
import pytest

from coview_stream.clouds import read_cloud, write_cloud
from coview_stream.errors import CloudError

POINTS = np.random.default_rng(2).normal(0, 20, (60, 3)).astype(np.float32)
PLY = "ply\nformat binary_little_endian 1.0\n{before}element vertex 2\n{axes}end_header\n"
AXES = "property float x\nproperty float y\nproperty float z\n"
ROWS = np.arange(6, dtype="<f4").tobytes()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("part", "at", "number", "reason"),
    [
        *(("chunk size", 0, n, "damaged or truncated") for n in (0x84000000, 0xFFFFFFFE, 0x7FFFFFFF, 0xFFFFFFFF)),
        *(("layers", 4 * layer, 0xF0000000, r"a\.laz") for layer in range(9)),
        ("point count", 0, 10**9, "points cannot be in"),
        ("variable records", 3, 0xF0, "more variable"),
        ("chunk table", 4, 1, "chunk table"),
        ("chunks", 3, 0xF0, "more chunks"),
    ],
)
def test_absurd_numbers_in_a_laz_are_refused(tmp_path, part, at, number, reason):
    path = tmp_path / "a.laz"
    write_cloud(path, POINTS)
    content = bytearray(path.read_bytes())
    points = int.from_bytes(content[96:100], "little")
    places = {
        "chunk size": content.index(b"laszip encoded") - 2 + 54 + 12,
        "layers": points + 8 + 30 + 4,
        "point count": 247,
        "variable records": 100,
        "chunk table": points,
        "chunks": int.from_bytes(content[points : points + 8], "little") + 4,
    }
    raw = number.to_bytes(1 if number < 256 else 4, "little")
    content[places[part] + at : places[part] + at + len(raw)] = raw
    path.write_bytes(content)
    with pytest.raises(CloudError, match=reason):
        read_cloud(path)


def ply_with(path, before, body, axes=AXES):
    path.write_bytes(PLY.format(before=before, axes=axes).encode() + body + ROWS)


def test_ply_element_of_a_trillion_rows_is_refused(tmp_path):
    ply_with(tmp_path / "a.ply", f"element face {10**12}\nproperty uchar a\n", bytes(100))
    with pytest.raises(CloudError, match="truncated PLY"):
        read_cloud(tmp_path / "a.ply")


def test_ply_with_lists_before_its_vertices_is_refused(tmp_path):
    ply_with(tmp_path / "a.ply", "element face 1\nproperty list uchar int v\n", bytes(1))
    with pytest.raises(CloudError, match=r"a\.ply: PLY with lists before its vertices \(face\); export it"):
        read_cloud(tmp_path / "a.ply")


def test_ply_property_named_twice(tmp_path):
    # of an element that is skipped it does no harm
    ply_with(tmp_path / "a.ply", "element odd 1\nproperty int a\nproperty int a\n", bytes(8))
    assert len(read_cloud(tmp_path / "a.ply")) == 2
    ply_with(tmp_path / "b.ply", "", b"", AXES + "property float x\n")
    with pytest.raises(CloudError, match="twice"):
        read_cloud(tmp_path / "b.ply")


def pcd(path, count="1", points="1", data="binary", body=bytes(16)):
    head = "VERSION 0.7\nFIELDS x y z i\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 {}\nWIDTH {}\nPOINTS {}\nDATA {}\n"
    path.write_bytes(head.format(count, points, points, data).encode() + body)
    return path


@pytest.mark.parametrize("number", [str(10**12), str(10**30), "9" * 5000, str(2**31), str(2**63)])
@pytest.mark.parametrize("data", ["ascii", "binary", "binary_compressed"])
def test_absurd_counts_and_points_of_a_pcd_are_refused(tmp_path, number, data):
    for fields in ({"count": number}, {"points": number}):
        with pytest.raises(CloudError, match=r"a\.pcd"):
            read_cloud(pcd(tmp_path / "a.pcd", data=data, **fields))


def test_pcd_that_claims_to_unpack_to_more_than_lzf_can_is_refused(tmp_path):
    body = struct.pack("<II", 100, 0xFFFFFFFF) + bytes(100)
    with pytest.raises(CloudError, match="cannot unpack"):
        read_cloud(pcd(tmp_path / "a.pcd", data="binary_compressed", body=body))


def test_npy_that_claims_more_than_it_holds_is_refused(tmp_path):
    write_cloud(tmp_path / "a.npy", POINTS)
    whole = (tmp_path / "a.npy").read_bytes()
    for shape in (b"(99999999999999, 3)", b"(-1, 3)", b"(9223372036854775807, 9)"):
        old = b"(60, 3)"
        pad = len(shape) - len(old)
        (tmp_path / "a.npy").write_bytes(whole.replace(old, shape).replace(b" " * pad, b"", 1))
        with pytest.raises(CloudError, match=r"a\.npy"):
            read_cloud(tmp_path / "a.npy")
