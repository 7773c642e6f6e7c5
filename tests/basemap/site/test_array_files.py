"""Arrays in files: what was written is read back, a full disk is an error, and nothing is left behind."""

import numpy as np
import pytest

from coview_stream.basemap.site.array_files import ArrayFiles
from coview_stream.errors import MapError


def test_rows_that_are_appended_are_one_array(tmp_path):
    rng = np.random.default_rng(1)
    parts = [rng.integers(0, 99, (n, 2, 3)).astype(np.int16) for n in (4, 0, 7)]
    with ArrayFiles(tmp_path) as files:
        assert [files.append("a", part) for part in parts] == [0, 4, 4]
        np.testing.assert_array_equal(files.rows("a", 3, 9), np.concatenate(parts)[3:9])
        found = files.arrays()["a"]
    np.testing.assert_array_equal(found, np.concatenate(parts))  # also after it was closed
    assert not found.flags.writeable
    assert not list(tmp_path.iterdir())


def test_what_was_written_to_an_array_of_zeros_stays_when_its_memory_goes(tmp_path):
    with ArrayFiles(tmp_path) as files:
        made = files.zeros("a", (3, 1000), np.float32)
        made[1] = 5.0
        files.release()
        assert made.sum() == 5000.0
        np.testing.assert_array_equal(files.arrays()["a"], made)


def test_arrays_of_nothing(tmp_path):
    with ArrayFiles(tmp_path) as files:
        files.append("a", np.zeros((0, 3), np.int8))
        files.zeros("b", (0, 4), np.int32)
        assert [(name, array.shape, array.dtype) for name, array in files.arrays().items()] == [
            ("a", (0, 3), np.int8),
            ("b", (0, 4), np.int32),
        ]


def test_rows_of_another_kind_and_names_that_are_taken_are_refused(tmp_path):
    with ArrayFiles(tmp_path) as files:
        files.append("a", np.zeros((1, 3), np.int8))
        with pytest.raises(ValueError, match="rows of a"):
            files.append("a", np.zeros((1, 3), np.int16))
        with pytest.raises(ValueError, match="there already"):
            files.zeros("a", (1,), np.int8)


def test_full_disk_is_an_error_that_names_the_folder(tmp_path, full_disk):
    with full_disk(9), ArrayFiles(tmp_path) as files, pytest.raises(MapError, match=r"File too large.*COVIEW_CACHE"):
        files.zeros("a", (10,), np.int8)


def test_rows_that_found_no_room_are_not_among_the_others(tmp_path, full_disk):
    with ArrayFiles(tmp_path) as files:
        files.append("a", np.full((4, 2), 1, np.int32))
        with full_disk(38), pytest.raises(MapError, match="File too large"):
            files.append("a", np.full((4, 2), 2, np.int32))  # of which six bytes are written
        assert files.append("a", np.full((1, 2), 3, np.int32)) == 4
        np.testing.assert_array_equal(files.arrays()["a"], [[1, 1]] * 4 + [[3, 3]])
