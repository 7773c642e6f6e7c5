"""A program that starts again goes on from the place and the calibration that it saved."""

import json

import numpy as np
import pytest
from trackers import follow

from coview_stream.errors import InputError
from coview_stream.geometry.transforms import pose_from
from coview_stream.localization.calibration.calibration import Calibration
from coview_stream.localization.localizer import Localizer
from coview_stream.localization.result import Fix
from coview_stream.localization.saved_state import SavedState
from coview_stream.localization.state import State


class Robot(SavedState):
    """A localizer that knows this pose, and notes what it is told."""

    def __init__(self, T_map_body=None, calibration=Calibration(), frames=1):  # noqa: B008  # frozen
        self.T_map_body, self.calibration, self.frames, self.told = T_map_body, calibration, frames, []

    def fix(self):
        if not self.frames:
            raise RuntimeError("no frame yet")
        if self.T_map_body is None:
            return Fix(1.0, State.SEARCHING)
        return Fix(1.0, State.TRACKING, T_map_body=self.T_map_body)

    def hint_pose(self, T_map_body):
        self.told.append(T_map_body)

    def hint_calibration(self, earlier):
        self.told.append(earlier)


def place(x):
    return pose_from(np.eye(3), [x, 0.0, 0.0])


def test_pose_and_calibration_come_back(tmp_path):
    path, calibration = tmp_path / "r1.json", Calibration(roll=0.1, scale=0.02, ground=0.3)
    Robot(place(448_000.25), calibration).save_state(path)
    again = Robot()
    assert again.load_state(path) is True
    np.testing.assert_array_equal(again.told[0], place(448_000.25))
    assert again.told[1] == calibration


def test_pose_of_the_file_stays_while_there_is_none(tmp_path):
    path = tmp_path / "r1.json"
    Robot(place(3.0)).save_state(path)
    Robot(calibration=Calibration(roll=0.2)).save_state(path)
    again = Robot()
    again.load_state(path)
    np.testing.assert_array_equal(again.told[0], place(3.0))
    assert again.told[1].roll == 0.2


def test_file_stays_before_the_first_frame_and_a_damaged_one_is_replaced(tmp_path):
    path = tmp_path / "r1.json"
    Robot(place(3.0), Calibration(scale=0.03)).save_state(path)
    saved = path.read_bytes()
    Robot(frames=0).save_state(path)
    assert path.read_bytes() == saved
    path.write_bytes(b"")
    Robot().save_state(path)
    assert Robot().load_state(path) is True


def test_first_start_has_no_file(tmp_path):
    robot = Robot()
    assert robot.load_state(tmp_path / "none.json") is False
    assert robot.told == []


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"version": 2}, "version 2, this release reads 1"),
        ({"format": "site"}, "something else"),
        ({"T_map_body": [[1, 2], [3, 4]]}, "not a finite rigid"),
        ({"calibration": {"scale": 1e9}}, "scale is 1000000000.0"),
    ],
)
def test_other_file_is_refused_by_name(tmp_path, change, text):
    path = tmp_path / "r1.json"
    Robot(place(3.0)).save_state(path)
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(InputError, match=rf"r1\.json: .*{text}"):
        Robot().load_state(path)


@pytest.mark.slow
def test_localizer_goes_on_where_it_was(world_map, world_drive, tmp_path):
    first, again = Localizer(world_map), Localizer(world_map)
    known = follow(first, world_drive)[-1]
    assert known.T_map_body is not None
    first.save_state(tmp_path / "r1.json")
    assert again.load_state(tmp_path / "r1.json")
    (fix,) = follow(again, world_drive, [len(world_drive.clouds) - 1], 0.5)
    np.testing.assert_allclose(fix.position, known.position, atol=0.1)
