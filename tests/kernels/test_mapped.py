"""Large arrays of files are used by windows, which leave memory again."""

import sys
from pathlib import Path

import numpy as np
import pytest

from coview_kernels import StationCodes
from coview_kernels.mapped import Windows, take_rows


@pytest.fixture
def windowed(windows):
    windows(1 << 15, 1 << 14)


def stored(array, path):
    np.save(path, array)
    return np.load(path, mmap_mode="r")


def resident_bytes():
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("RssFile:"):
            return 1024 * int(line.split()[1])
    raise AssertionError("no RssFile")


def test_windows_cover_all_rows_once(windowed, tmp_path):
    array = stored(np.arange(50_000, dtype=np.int32).reshape(-1, 5), tmp_path / "a.npy")
    windows = Windows(array)
    parts = list(windows)
    assert windows.several
    assert np.concatenate([array[part, 0] for part in parts]).tolist() == array[:, 0].tolist()
    assert max(part.stop - part.start for part in parts) * 20 <= 1 << 14


def test_arrays_in_memory_small_ones_and_those_that_may_be_written_to_are_one_window(windowed, tmp_path):
    array = np.zeros((10_000, 5), dtype=np.int32)
    np.save(tmp_path / "a.npy", array)
    writable = np.load(tmp_path / "a.npy", mmap_mode="c")
    for each in (array, stored(array[:100], tmp_path / "b.npy"), writable):
        assert not Windows(each).several
        assert list(Windows(each)) == [slice(0, len(each))]
    assert list(Windows(array[:0])) == []


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_what_a_window_brought_into_memory_is_released(tmp_path, windows):
    windows(1 << 20, 1 << 20)
    array = stored(np.ones((1 << 12, 1 << 13), dtype=np.uint8), tmp_path / "a.npy")  # 32 MB
    before = resident_bytes()
    total = sum(int(array[part, ::512].sum()) for part in Windows(array))
    assert total == array.shape[0] * (array.shape[1] // 512)
    assert resident_bytes() - before < 12 << 20


def test_rows_are_copied_in_the_order_asked_for_and_missing_ones_refused(windowed, tmp_path):
    array = stored(np.arange(50_000, dtype=np.int32).reshape(-1, 5), tmp_path / "a.npy")
    rows = np.random.default_rng(3).integers(0, len(array), 700)
    for given in (array, np.array(array)):
        np.testing.assert_array_equal(take_rows(given, rows), array[rows])
    assert take_rows(array, rows[:0]).shape == (0, 5)
    assert take_rows(array[:0], rows[:0]).shape == (0, 5)
    for given in (array, np.array(array)):
        with pytest.raises(IndexError):
            take_rows(given, np.array([3, len(array)]))


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_single_codes_of_a_large_file_take_little_memory(tmp_path, monkeypatch, windows):
    rng = np.random.default_rng(8)
    codes = StationCodes.of([rng.random((300, 20, 60), dtype=np.float32)])
    rows = np.lib.format.open_memmap(tmp_path / "codes.npy", "w+", np.int16, (400_000, 16, 16))  # 205 MB
    rows[:] = codes.codes[0]
    rows.flush()
    del rows
    file = StationCodes(
        np.load(tmp_path / "codes.npy", mmap_mode="r"), codes.basis, codes.step, codes.norm, codes.sectors
    )
    assert Windows(file.codes).several
    query = codes.query(rng.random((20, 60), dtype=np.float32))
    windows(1 << 26, 1 << 23)
    expected = codes.at(query, [0], [0])[0]  # the library is loaded
    before = most = resident_bytes()
    release = Windows._release

    def measured(self, part):
        nonlocal most
        most = max(most, resident_bytes())
        release(self, part)

    monkeypatch.setattr(Windows, "_release", measured)
    chosen = rng.integers(0, 400_000, 3000)
    found = file.at(query, chosen, np.zeros(3000, dtype=np.int64))
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert most - before < 30 << 20
    assert resident_bytes() - before < 20 << 20


def test_codes_of_a_file_answer_by_windows_as_those_in_memory_do(windowed, tmp_path):
    rng = np.random.default_rng(8)
    descriptors = [rng.random((300, 20, 60), dtype=np.float32) for _ in range(2)]
    codes = StationCodes.of(descriptors)
    rows = stored(codes.codes, tmp_path / "codes.npy")
    file = StationCodes(rows, codes.basis, codes.step, codes.norm, codes.sectors)
    assert Windows(rows).several
    query = codes.query(np.concatenate([each[7] for each in descriptors]))
    np.testing.assert_array_equal(file.best(query), codes.best(query))
    chosen = rng.integers(0, 300, 500)
    np.testing.assert_array_equal(file.all_shifts(query, chosen), codes.all_shifts(query, chosen))
    other = codes.query(np.concatenate([each[9] for each in descriptors]))
    requests = [
        (query, np.append(chosen, -1), np.append(rng.integers(0, 60, 500), 3)),
        (other, np.array([-1, 299, 0, 150]), np.array([0, 59, 30, 1])),
        (query, np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)),
    ]
    for found, expected in zip(file.at_all(requests), codes.at_all(requests), strict=True):
        np.testing.assert_array_equal(found, expected)
    assert file.at_all(requests)[1][0] == 0.0
    some = file.subset(chosen[:40])
    np.testing.assert_array_equal(some.best(query), codes.best(query)[chosen[:40]])
    assert not isinstance(some.codes, np.memmap)
