"""Every fault of a cloud's file raises one CloudError that names the file."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from coview_stream.clouds import read_cloud, write_cloud
from coview_stream.errors import CloudError

POINTS = np.random.default_rng(2).normal(0, 20, (60, 3)).astype(np.float32)
SUFFIXES = [".pcd", ".ply", ".npy", ".las", ".laz", ".bin"]
HEADER = "VERSION 0.7\nFIELDS {f}\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {n}\nPOINTS {n}\nDATA ascii\n"


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_missing_file_empty_file_directory_and_junk_are_refused(tmp_path, suffix):
    for name, content in (("text", b"just some words\n" * 40), ("html", b"<!DOCTYPE html><html>" + b" " * 43)):
        (tmp_path / f"{name}{suffix}").write_bytes(content)
    (tmp_path / f"empty{suffix}").touch()
    (tmp_path / f"folder{suffix}").mkdir()
    reasons = {"missing": "no such file", "empty": "empty", "folder": "directory", "text": "text", "html": "HTML"}
    for name, reason in reasons.items():
        with pytest.raises(CloudError, match=reason) as caught:
            read_cloud(tmp_path / f"{name}{suffix}")
        assert f"{name}{suffix}" in str(caught.value)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_file_without_points_is_refused(tmp_path, suffix):
    write_cloud(tmp_path / f"a{suffix}", np.zeros((0, 3), np.float32))
    with pytest.raises(CloudError, match=r"zero points|is empty"):
        read_cloud(tmp_path / f"a{suffix}")


@pytest.mark.parametrize("suffix", [".pcd", ".ply", ".npy", ".bin"])
def test_file_with_only_nan_points_is_refused(tmp_path, suffix):
    write_cloud(tmp_path / f"a{suffix}", np.full((9, 3), np.nan, np.float32))
    with pytest.raises(CloudError, match="none of the 9 points"):
        read_cloud(tmp_path / f"a{suffix}")


@pytest.mark.parametrize(("real", "named"), [(".ply", ".pcd"), (".pcd", ".laz"), (".laz", ".ply"), (".npy", ".bin")])
def test_content_of_another_format_is_refused(tmp_path, real, named):
    write_cloud(tmp_path / f"a{real}", POINTS[:52])
    (tmp_path / f"a{real}").rename(tmp_path / f"a{named}")
    content = "LAS" if real == ".laz" else real[1:].upper()
    with pytest.raises(CloudError, match=f"content is {content}"):
        read_cloud(tmp_path / f"a{named}")


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("a.wrl", b"1 2 3\n", "unknown cloud suffix"),
        ("a.pcd", HEADER.format(f="x y q", n=1).encode() + b"1 2 3\n", "no field z"),
        ("a.pcd", HEADER.format(f="x y z", n=2).encode() + b"1 2 3\n", "truncated"),
        ("a.pcd", HEADER.format(f="x y z", n=2).encode() + b"1 2 3\n1 a 3\n", "unreadable ascii"),
        ("a.pcd", HEADER.format(f="x y z", n=10**15).encode() + b"1 2 3\n", "truncated"),
        ("a.pcd", HEADER.format(f="x y z", n=2).replace("SIZE 4", "SIZE 3").encode(), "TYPE and SIZE"),
        ("a.pcd", HEADER.format(f="x y z", n=2).replace("ascii", "zip").encode(), "unknown encoding"),
        ("a.ply", b"ply\nformat ascii 1.0\nelement face 0\nend_header\n", "without a vertex"),
        ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n", "have no y, z"),
        ("a.ply", b"ply\nformat odd 1.0\nend_header\n", "damaged PLY header"),
        ("a.bin", b"\x01\xff" * 15, "not a multiple"),
    ],
)
def test_damaged_content_is_refused_with_reason(tmp_path, name, content, reason):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(CloudError, match=reason):
        read_cloud(tmp_path / name)


@pytest.mark.parametrize("array", [np.zeros(9), np.zeros((4, 2)), np.array([["a"] * 3]), np.array([[None] * 3])])
def test_npy_of_wrong_shape_or_type_is_refused(tmp_path, array):
    np.save(tmp_path / "a.npy", array, allow_pickle=True)
    with pytest.raises(CloudError, match=r"a\.npy"):
        read_cloud(tmp_path / "a.npy")


@pytest.fixture(scope="module")
def originals(tmp_path_factory):
    folder = tmp_path_factory.mktemp("originals")
    for suffix in SUFFIXES:
        write_cloud(folder / f"a{suffix}", POINTS)
    return {suffix: (folder / f"a{suffix}").read_bytes() for suffix in SUFFIXES}


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(suffix=st.sampled_from(SUFFIXES), share=st.floats(0, 1, exclude_max=True))
def test_file_truncated_anywhere_is_refused(tmp_path, originals, suffix, share):
    whole = originals[suffix]
    cut = int(share * len(whole))
    path = tmp_path / f"cut{suffix}"
    path.write_bytes(whole[:cut])
    if suffix == ".bin" and cut % 16 == 0 and cut:
        # rows without a header: a shorter file is a shorter cloud
        np.testing.assert_array_equal(read_cloud(path).points, POINTS[: cut // 16])
        return
    with pytest.raises(CloudError, match="cut"):
        read_cloud(path)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    suffix=st.sampled_from([".pcd", ".ply", ".npy", ".las"]),
    where=st.floats(0, 1, exclude_max=True),
    bit=st.integers(0, 7),
)
def test_flipped_bits_give_cloud_or_cloud_error(tmp_path, originals, suffix, where, bit):
    content = bytearray(originals[suffix])
    # the header decides; flips in coordinates are mere coordinates
    content[int(where * min(400, len(content)))] ^= 1 << bit
    path = tmp_path / f"flip{suffix}"
    path.write_bytes(content)
    try:
        cloud = read_cloud(path)
    except CloudError:
        return
    assert np.isfinite(cloud.points).all()
