"""What the forest benchmark keeps is used again only if nothing that it depends on has changed."""

import os
from pathlib import Path

from bench.forest.common import ANSWERS, WORLDS, code, on_disk

ROOT = Path(__file__).parents[2]


def test_what_lies_in_a_folder_is_known_by_its_files(tmp_path):
    (tmp_path / "run" / "frames").mkdir(parents=True)
    for name in ("base.laz", "run/odometry.tum", "run/frames/000000.pcd"):
        (tmp_path / name).write_bytes(b"one")
    before = on_disk(tmp_path)
    assert on_disk(tmp_path) == before
    (tmp_path / "run" / "frames" / "000000.pcd").write_bytes(b"other")
    changed = on_disk(tmp_path)
    assert changed != before
    stat = (tmp_path / "base.laz").stat()
    os.utime(tmp_path / "base.laz", ns=(stat.st_atime_ns, stat.st_mtime_ns + 1_000_000))
    assert on_disk(tmp_path) not in (before, changed)


def test_answers_depend_on_all_that_makes_worlds_and_on_what_is_measured():
    for part in ("coview_stream/sim", "coview_stream/clouds", "coview_stream/geometry/transforms.py",
                 "coview_stream/geometry/rotations.py", "coview_stream/training/submaps.py", "coview_stream/place",
                 "coview_stream/localization/search/refinement.py", "bench/forest/chains.py"):  # fmt: skip
        assert part in ANSWERS
    assert set(WORLDS) < set(ANSWERS)
    assert len(code()) == 10  # every file and folder is there
    for part in ANSWERS:
        package, _, rest = part.partition("/")
        root = ROOT / "kernels" if package == "coview_kernels" else ROOT
        assert (root / package / rest).exists(), part
