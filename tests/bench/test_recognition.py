"""Readers of public sets of submaps, on tiny made-up directories in their layouts, and the recalls that they give."""

from __future__ import annotations

import argparse
import pickle

import numpy as np
import pytest

from bench.forest import recognition
from bench.forest.places import Submap, read_sites
from bench.forest.recognition import averages, rank, recalls, spread, tables
from coview_stream.clouds import write_cloud
from coview_stream.errors import InputError
from coview_stream.geometry.transforms import exp_so3, inverse, pose_from, pose_to_tum, rot_z, transform

HEAD = "timestamp,x,y,z,qx,qy,qz,qw\n"


def forest(seed=0):
    """Ground with boxes of foliage on it, 160 m wide."""
    rng = np.random.default_rng(seed)
    ground = np.column_stack([rng.uniform(-80.0, 80.0, (60_000, 2)), rng.normal(0.0, 0.03, 60_000)])
    trees = [
        rng.uniform([x - w, y - w, 0.0], [x + w, y + w, h], (600, 3))
        for x, y, w, h in zip(
            *rng.uniform(-80, 80, (2, 90)), rng.uniform(0.3, 2, 90), rng.uniform(3, 15, 90), strict=True
        )
    ]
    return np.concatenate([ground, *trees])


def write_traverse(folder, poses, csv, clouds, points, radius=30.0):
    (folder / clouds).mkdir(parents=True)
    lines = []
    for k, pose in enumerate(poses):
        stamp = f"{1623370408 + k}.092646"
        near = points[np.hypot(*(points[:, :2] - pose[:2, 3]).T) < radius]
        write_cloud(folder / clouds / f"{stamp}.pcd", transform(inverse(pose), near).astype(np.float32))
        lines.append(f"{stamp},{','.join(f'{value:.9f}' for value in pose_to_tum(pose))}\n")
    (folder / csv).write_text(HEAD + "".join(lines))


def along(count, y, tilt=0.0):
    lean = exp_so3(np.array([tilt, 0.0, 0.0]))
    return [pose_from(rot_z(0.7 * k) @ lean, np.array([-45.0 + 90.0 * k / (count - 1), y, 1.5])) for k in range(count)]


@pytest.fixture
def wild(tmp_path):
    """A site without published regions, in the layout of Wild-Places."""
    points = forest()
    for name, y, tilt in (("01", 0.0, 0.0), ("02", 1.0, 0.1)):
        write_traverse(tmp_path / "Tiny" / name, along(5, y, tilt), "poses_aligned.csv", "Clouds_downsampled", points)
    return tmp_path


@pytest.fixture
def crossed(tmp_path):
    """A site in the layout of CS-Wild-Places: aerial submaps, and ground ones between them."""
    points = forest()
    write_traverse(tmp_path / "Tiny" / "2024_aerial_sample10m", along(7, 0.0), "poses.csv", "clouds", points)
    write_traverse(tmp_path / "Tiny" / "2021_ground_sample0.5s", along(4, 2.0), "poses.csv", "clouds", points)
    return tmp_path


@pytest.fixture
def campus(tmp_path):
    """CS-Campus3D: normalised clouds of float64 triples, named by pickles."""
    rng = np.random.default_rng(0)

    def entry(name, northing):
        (tmp_path / "umd" / "a").mkdir(parents=True, exist_ok=True)
        rng.uniform(-1.0, 1.0, (4096, 3)).tofile(tmp_path / "umd" / "a" / name)
        return {"query": f"umd/a/{name}", "northing": np.float64(northing), "easting": 0.0}

    database = [{k: entry(f"d{k}.bin", 20.0 * k) for k in range(4)}]
    queries = [{k: entry(f"q{k}.bin", 30.0 * k) | {0: [k]} for k in range(2)} | {2: entry("far.bin", 900.0) | {0: []}}]
    for name, value in (("database", database), ("query", queries)):
        (tmp_path / f"umd_evaluation_{name}.pickle").write_bytes(pickle.dumps(value))
    return tmp_path


def options(data, *words):
    parser = argparse.ArgumentParser()
    parser.add_argument("--quick", action="store_true")
    recognition.options(parser)
    return parser.parse_args([str(data), *words])


def test_wild_places_has_a_database_and_queries_in_each_walk(wild):
    (site,) = read_sites(wild)
    assert [(each.name, len(each.submaps), each.searched) for each in site.traverses] == [
        ("01", 5, True),
        ("02", 5, True),
    ]
    assert site.pairs() == [(0, 1), (1, 0)]
    assert site.right(0, 1, 3) == [3]
    assert read_sites(wild, within=30.0)[0].right(0, 1, 3) == [2, 3, 4]


def test_submaps_are_turned_upright_but_not_to_the_north(wild):
    (site,) = read_sites(wild)
    straight, leaning = (each.submaps[2] for each in site.traverses)
    assert np.linalg.norm(leaning.pose[:3, :3] - leaning.upright[:3, :3]) > 0.05
    for submap in (straight, leaning):
        cloud = submap.cloud(50.0)
        below = cloud[np.hypot(cloud[:, 0], cloud[:, 1]) < 25.0, 2]
        assert abs(np.percentile(below, 10) + 1.5) < 0.15
    np.testing.assert_allclose(straight.upright[:3, :3], rot_z(1.4), atol=1e-6)


def test_queries_lie_in_the_published_regions(tmp_path):
    spots = [(-400.0, 0.0), (-250.0, 300.0), (0.0, 0.0)]
    poses = [pose_from(np.eye(3), np.array([*xy, 0.0])) for xy in spots]
    cloud = np.concatenate([np.array([[x, y, 0.0], [x + 2.0, y, 1.0]]) for x, y in spots])
    write_traverse(tmp_path / "Venman" / "V-01", poses, "poses.csv", "Clouds", cloud)
    ((traverse,),) = (each.traverses for each in read_sites(tmp_path))
    assert traverse.queries == [0, 2]


def test_cs_wild_places_asks_from_the_ground_in_the_air(crossed):
    (site,) = read_sites(crossed)
    ground, air = site.traverses
    assert (ground.searched, air.searched) == (False, True)
    assert (ground.queries, air.queries) == ([0, 1, 2, 3], [])
    assert site.pairs() == [(1, 0)]
    assert site.within == 30.0


def test_cs_campus3d_says_what_is_right(campus):
    (site,) = read_sites(campus)
    assert site.pairs() == [(0, 1)]
    assert [site.right(0, 1, k) for k in range(3)] == [[0], [1], []]
    assert recognition.asked_of(site, (0, 1), 0) == [0, 1]
    cloud = site.traverses[0].submaps[0].cloud(50.0)
    assert cloud.shape == (4096, 3)
    assert 45.0 < np.abs(cloud).max() <= 50.0


@pytest.mark.parametrize(
    ("broken", "said"),
    [
        (lambda root: (root / "Tiny" / "01" / "poses_aligned.csv").unlink(), r"01: no poses_aligned\.csv"),
        (lambda root: (root / "Tiny" / "01" / "Clouds_downsampled").rename(root / "other"), "01: no clouds"),
        (lambda root: (root / "Tiny" / "01" / "poses_aligned.csv").write_text("t,x\n1,2\n"), "no column timestamp"),
        (lambda root: (root / "Tiny" / "01" / "poses_aligned.csv").write_text(HEAD), "holds no pose"),
        (lambda root: (root / "Tiny" / "01" / "poses_aligned.csv").write_text(HEAD + "1,a" + 6 * ",0"), r"csv:2: not"),
    ],
)  # fmt: skip
def test_what_is_missing_is_named(wild, broken, said):
    broken(wild)
    with pytest.raises(InputError, match=said):
        read_sites(wild)


def test_a_folder_without_a_set_and_a_missing_cloud_are_named(wild, tmp_path_factory):
    with pytest.raises(InputError, match="no set that is known"):
        read_sites(tmp_path_factory.mktemp("empty"))
    (site,) = read_sites(wild)
    submap = site.traverses[0].submaps[1]
    submap.file.unlink()
    with pytest.raises(InputError, match=submap.file.name):
        submap.cloud(50.0)


def test_half_a_campus_is_named(campus):
    (campus / "umd_evaluation_query.pickle").unlink()
    with pytest.raises(InputError, match=r"umd_evaluation_query\.pickle: not there"):
        read_sites(campus)


class _Harmful:
    def __reduce__(self):
        return (print, ("run",))


def test_nothing_in_a_pickle_is_run(campus, capsys):
    (campus / "umd_evaluation_query.pickle").write_bytes(pickle.dumps([{0: _Harmful()}]))
    with pytest.raises(InputError, match="no plain data"):
        read_sites(campus)
    assert "run" not in capsys.readouterr().out


def test_a_truncated_cloud_is_refused(tmp_path):
    np.zeros(4).tofile(tmp_path / "a.bin")
    with pytest.raises(InputError, match="no x y z"):
        Submap(tmp_path / "a.bin", np.zeros(2)).cloud(50.0)


def test_ranks_and_recalls():
    distance = np.array([0.4, 0.1, 0.3, 0.2], np.float32)
    assert rank(distance, [1]) == 1
    assert rank(distance, [0, 2]) == 3
    assert rank(np.ones(4, np.float32), [2]) == 4  # nothing tells them apart
    found = recalls(np.array([1, 2, 5, 10]), 300)
    assert found == pytest.approx({"AR@1": 25.0, "AR@5": 75.0, "AR@1 %": 50.0, "MRR": 45.0})
    assert spread(list(range(10)), 3) == [0, 4, 9]


def test_every_method_finds_its_own_forest(crossed):
    """The same points from both sides: an easy set, but all of the way from files to tables."""
    asked = options(crossed, "--within", "8")
    rows = list(recognition.rows(asked))
    assert [row.details["n"] for row in rows] == [4]
    found = averages([row.details for row in rows])
    for method in recognition.METHODS:
        assert found[method]["AR@5"] >= 75.0
    assert "AR@1 %" in tables(rows, asked)[""]


@pytest.mark.slow
def test_a_map_of_the_aerial_submaps_can_be_asked(crossed):
    asked = options(crossed, "--as-map", "--within", "8")
    rows = list(recognition.rows(asked))
    assert rows[-1].details["map"]["dense"]["AR@5"] >= 75.0
    assert "dense" in tables(rows, asked)["map"]
