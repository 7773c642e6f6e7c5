"""A part of what is seen that fits some metres beside the rest is found; what was merely replaced is not."""

from dataclasses import replace

import numpy as np
import pytest
from trackers import observed

import coview_kernels as kernels
from coview_stream.geometry.transforms import exp_so3, inverse, pose_from, rot_z, transform
from coview_stream.localization.evidence.moved_part import (
    NO_PART,
    MovedPart,
    SeenStructure,
    find_moved_part,
    log_odds_of_moved,
)
from coview_stream.localization.evidence.observation import ObservedScan

ODOM = pose_from(rot_z(-0.7), [12.0, 40.0, 3.0])  # map <- odometry
RISK = 1e-4


def scan_of(drive, frame: int) -> ObservedScan:
    return observed(drive.clouds[frame], inverse(ODOM) @ drive.T_map_body[frame], voxels=False)


@pytest.fixture(scope="module")
def seen(world_drive):
    return scan_of(world_drive, 0)


def with_moved(scan: ObservedScan, shifts: np.ndarray, centre: ObservedScan | None = None) -> ObservedScan:
    """The scan with what stands in each of a few sectors moved, (sectors, 2) metres along the map's axes."""
    structure = scan.many.points.structure.copy()
    x, y = (structure[:, :2] + (scan.body - (centre or scan).body)[:2]).T  # what moves is the same in all scans
    sector = ((np.arctan2(y, x) + np.pi) / (2 * np.pi) * len(shifts)).astype(int)
    back = ODOM[:2, :2].T  # the odometry frame's axes
    structure[:, :2] += (shifts @ back.T)[np.minimum(sector, len(shifts) - 1)].astype(np.float32)
    return replace(scan, many=replace(scan.many, points=replace(scan.many.points, structure=structure)))


def found(world_map, *scans: ObservedScan, T_map_odom: np.ndarray = ODOM) -> MovedPart:
    return find_moved_part(world_map.field, scans, T_map_odom)


def test_scan_that_is_explained_has_no_moved_part(world_map, seen):
    assert found(world_map, seen).probability < RISK


def test_third_of_the_scan_that_is_four_metres_off_is_found(world_map, seen):
    shifts = np.zeros((12, 2))
    shifts[::3] = [-4.0, 0.5]
    part = found(world_map, with_moved(seen, shifts))
    assert part.probability > RISK > 5 * found(world_map, seen).probability
    assert part.metres == pytest.approx(4.0, abs=0.8)


def test_parts_that_moved_each_by_itself_are_no_moved_part(world_map, seen):
    angle = np.linspace(0.0, 2 * np.pi, 8, endpoint=False)
    shifts = np.zeros((24, 2))
    shifts[::3] = 4.5 * np.column_stack([np.cos(angle), np.sin(angle)])
    assert found(world_map, with_moved(seen, shifts)).probability < 5 * RISK


def test_evidence_of_several_keyframes_is_that_of_one_shift(world_map, world_drive, seen):
    shifts = np.zeros((12, 2))
    shifts[::4] = [-4.0, 0.5]
    scans = [scan_of(world_drive, frame) for frame in (9, 5)]
    part = found(world_map, *(with_moved(scan, shifts, seen) for scan in [*scans, seen]))
    assert part.probability > 0.9
    assert part.metres == pytest.approx(4.0, abs=0.8)
    assert found(world_map, *scans, seen).probability < RISK


def test_lean_of_the_sensor_leaves_nothing_unexplained(world_map, world_drive):
    """It turns with the body, and is the registered pose's against odometry's vertical."""

    def left(T_map_odom, *scans):
        return len(SeenStructure.of(world_map.field, scans, T_map_odom).unexplained)

    lean, clouds = pose_from(exp_so3([np.radians(4.0), 0.0, 0.0]), np.zeros(3)), world_drive.clouds
    T = [inverse(ODOM) @ world_drive.T_map_body[frame] for frame in (9, 5, 0)]
    leaning = [observed(transform(lean, clouds[k]), at, voxels=False) for k, at in zip((9, 5, 0), T, strict=True)]
    registered = ODOM @ T[-1] @ inverse(lean) @ inverse(T[-1])
    straight = left(ODOM, *(scan_of(world_drive, k) for k in (9, 5, 0)))
    assert left(registered, *leaning) < 1.5 * straight + 20
    assert left(ODOM, *leaning) > 3 * straight + 60


def test_what_the_scan_has_explained_at_the_place_is_no_second_time(world_map, seen):
    pose = seen.poses(ODOM[None])[0]
    points = seen.many.points.structure
    explained = points[~kernels.unexplained(world_map.field, points, pose)]
    back = (np.array([4.0, 1.0]) @ ODOM[:2, :2]).astype(np.float32)
    ghosts = explained[::4].copy()
    ghosts[:, :2] -= back  # seen where nothing is, and beside what is seen as well
    both = np.concatenate([points, ghosts])
    with_ghosts = replace(seen, many=replace(seen.many, points=replace(seen.many.points, structure=both)))
    alone = replace(seen, many=replace(seen.many, points=replace(seen.many.points, structure=ghosts)))
    assert 50 * found(world_map, with_ghosts).probability < found(world_map, alone).probability


def test_few_points_say_nothing(world_map, seen):
    few = replace(seen.many.points, structure=seen.many.points.structure[:9] + np.float32([0.0, 0.0, 40.0]))
    assert found(world_map, replace(seen, many=replace(seen.many, points=few))) == NO_PART


def log_odds(world_map, scan, metres, degrees=0.0):
    """That the scan fits where it was taken only since the map's objects have moved, and that it was so far beside."""
    body = ODOM @ scan.T_odom_body
    beside = pose_from(rot_z(np.radians(degrees)) @ body[:3, :3], body[:3, 3] + [metres, 0.0, 0.0])
    return log_odds_of_moved(world_map.field, [scan], ODOM, beside @ inverse(scan.T_odom_body))


def test_view_moved_as_a_whole_only_if_all_of_it_did(world_map, seen):
    """And a part of it moved where the rest fits beside."""
    whole = log_odds(world_map, seen, -4.0)
    shifts = np.zeros((12, 2))
    shifts[::3] = [4.0, 0.0]  # the rest of what is seen by a robot four metres behind
    part = log_odds(world_map, with_moved(seen, shifts), -4.0)
    assert whole < np.log(5e-4) - np.log(5.0)
    assert part > whole + 5.0
    assert log_odds(world_map, seen, -9.0) == -np.inf


def test_same_pose_but_for_its_heading_shows_other_objects_moved(world_map, seen):
    assert log_odds(world_map, seen, 0.0, 20.0) < log_odds(world_map, seen, 0.0) - 1.0
    assert log_odds(world_map, seen, 0.0) == pytest.approx(np.log(5e-4), abs=0.5)  # nothing tells them apart
