"""A run whose clouds or odometry lie: the doctor names the sensor, without a map, and contradicts itself nowhere."""

import re
from pathlib import Path

import numpy as np
import pytest
import small_world

from coview_stream.basemap.basemap import BaseMap
from coview_stream.clouds.cloud import Cloud
from coview_stream.clouds.reference_system import FOOT
from coview_stream.config import LocalizerConfig
from coview_stream.doctor import map_checks
from coview_stream.doctor.map_checks import place_finding, run_findings
from coview_stream.localization.calibration.calibration import Calibration
from coview_stream.recordings.run import Run

BEGIN = 18  # frame of the fault
DT = 0.2  # seconds between frames, at two metres per second

pytestmark = pytest.mark.slow


class Clouds(list):
    def read(self, index, correction=None):
        return Cloud(self[index], np.zeros(3))


@pytest.fixture(scope="module")
def way(scene):
    return small_world.record_along(scene, small_world.drive(12), 0.4)


def run_of(clouds, odometry):
    stamps = DT * np.arange(len(clouds))
    return Run(Path("run"), (Path("run"),) * len(clouds), stamps, np.array(odometry), Clouds(clouds))


def findings(clouds, odometry):
    return {finding.what: finding for finding in run_findings(run_of(clouds, odometry))}


def test_undisturbed_run_is_told_to_agree(way):
    found = findings(way.clouds, way.T_odom_body)
    assert found["sensors"].verdict == found["motion"].verdict == "ok"
    assert "calibration" not in found


@pytest.mark.parametrize(
    ("fault", "says"),
    [
        (lambda way, k: (way.clouds[BEGIN], way.T_odom_body[k]), "the lidar repeats itself"),
        (lambda way, k: (way.clouds[k], way.T_odom_body[BEGIN]), "odometry stands still while the lidar moves"),
        (lambda way, k: (way.clouds[(k * (1 + 20 * (k % 2))) % len(way.clouds)], way.T_odom_body[k]), "two drivers"),
    ],
    ids=["repeated", "stopped", "alternating"],
)
def test_sensor_that_lies_is_named_once_with_its_cause(way, fault, says):
    lies = [fault(way, k) if k >= BEGIN else (way.clouds[k], way.T_odom_body[k]) for k in range(len(way.clouds))]
    found = findings(*zip(*lies, strict=True))
    assert found["sensors"].verdict == "FAIL"
    assert says in found["sensors"].found
    assert [what for what, finding in found.items() if finding.verdict == "FAIL"] == ["sensors"]


@pytest.fixture(scope="module")
def in_feet(map_points, scene):
    """Return a run, and a map in feet of which no reference system says so."""
    drive = small_world.record_along(scene, small_world.drive(12), 1.0)
    near = map_points[np.abs(map_points[:, :2]).max(axis=1) < 32.0]
    base_map = BaseMap.build((near / FOOT).astype(np.float32), radius=30.0)
    return run_of(drive.clouds, drive.T_odom_body), base_map


def test_map_in_feet_is_named(in_feet):
    """The robot is found on the same map in metres; both searches tell of their progress."""
    told = []
    finding = place_finding(*in_feet, LocalizerConfig(), lambda *done: told.append(done))
    assert finding.verdict == "FAIL"
    assert re.match(r"the map is in feet: none on it after \d+ m: .*; found after .*wrong .*1 in", finding.found)
    assert "--crs feet" in finding.remedy
    total = len(in_feet[0])
    assert told[: total + 1] == [*((k, total) for k in range(1, total + 1)), (1, total)]


def test_large_map_is_not_built_again_in_metres(in_feet, monkeypatch):
    run, base_map = in_feet
    monkeypatch.setattr(map_checks, "_MAX_REBUILT", len(base_map.points) - 1)
    finding = place_finding(run, base_map, LocalizerConfig())
    assert re.match(r"none on \S.* \(-?\d+, -?\d+ to -?\d+, -?\d+ m\) after", finding.found)
    assert "(feet were not tried: " in finding.remedy


def test_beginning_of_a_long_run_on_no_map_is_told_as_such(in_feet):
    run, base_map = in_feet
    (sensors, *_) = map_checks.sensor_findings(run, base_map, LocalizerConfig())
    assert sensors.found.startswith("clouds and odometry tell the same motion")
    stands = run_of([run.read(0).points] * 250, run.poses[[0] * 249 + [-1]])
    place = place_finding(stands, base_map, LocalizerConfig())
    assert re.search(r"after 0 of [1-9]\d* m: ", place.found)
    assert "`locate` looks at all of the run" in place.remedy


@pytest.mark.parametrize("probability", [0.02, 0.98])
def test_fault_that_is_less_probable_than_none_fails_no_run(way, monkeypatch, probability):
    """Poses are withheld at one in a thousand; of many frames one reaches that by chance."""
    told = iter([None] * 5 + [("mixed", "clouds do not fit each other", probability)])
    judges = (lambda frame: next(told, None)), lambda: ("", Calibration(roll=0.02))
    monkeypatch.setattr(map_checks, "_judge", lambda *_: judges)
    run = run_of(way.clouds, way.T_odom_body)
    (found, *rest) = map_checks.sensor_findings(run, None, LocalizerConfig())
    assert (found.what, found.verdict) == ("sensors", "FAIL" if probability > 0.5 else "ok")
    # without a map the ground may slope: no mount is advised
    assert [(each.found.partition(":")[0], "--mount" in each.remedy) for each in rest] == (
        [] if probability > 0.5 else [("sensor leans 1.1 deg in roll", False)]
    )
