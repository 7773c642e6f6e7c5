"""Agreement of the motions that odometry, clouds and map show over a step, as likelihoods.

Over a step odometry moves by o, the clouds, registered to each other, by l, and registrations to the map by m. Each
registration fails with a small probability and is then arbitrary: mostly within metres of odometry's motion, where it
started, but any motion is possible (Student's t with one degree of freedom). Motions are planar: (x, y, heading) in the
level axes of the earlier body.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.planar import between
from coview_stream.geometry.transforms import wrap_angle
from coview_stream.localization.witness.stamps import StepStamps

FAILS = 0.05
"""Probability that clouds are registered wrongly, given their usual fit."""
MAP_FAILS = 0.02
"""Likewise for a verified registration to the map."""
ALONE = 0.05
"""Probability that clouds of one place with many points on surfaces do not fit each other."""
ANYWHERE: Floats = np.array([2.0, 2.0, math.radians(20.0)])
"""Scale of a wrong registration about odometry's motion: metres, radians."""
_APART = 0.7  # probability that clouds of several places do not fit each other
_ACCELERATIONS = np.array([0.25, 0.25, 0.12])  # sigmas in a hole of odometry, beyond the speeds around: m/s^2, rad/s^2
_WHOLE = 0.01  # seconds^2; odometry of five frames per second has no holes


class Seen(NamedTuple):
    """Motion (3,) seen by one witness, with its covariance (3, 3)."""

    motion: Floats
    covariance: Floats


@dataclass(frozen=True)
class Step:
    """One step of a robot by its witnesses; motions are planar: (x, y, heading) in the earlier body's axes."""

    seconds: float
    odometry: Seen
    clouds: Seen | None  # None if there is too little to register
    on_map: Seen | None  # None without a verified registration at both ends
    path_before: Floats  # (L, 3) odometry's planar poses by the LAGS of faults.py before the start of the step
    path_now: Floats  # likewise before its end
    fails: float = FAILS  # probability that the clouds' registration is wrong, by their fit
    apart: bool = False  # whether the clouds fit each other much less than usual
    alone: float = ALONE  # probability of ``apart`` for clouds of one place
    copied: bool = False  # whether the clouds are identical bytes
    same: float | None = None  # share of unmoved points, if the clouds hardly moved
    unsure: Floats | None = None  # (2, L) seconds^2 by which unseen accelerations move these poses, in odometry's holes
    stamps: StepStamps | None = None  # of the clouds
    start: Floats | None = None  # (3,) second start of the clouds' registration beside odometry's motion
    tilting: float = 0.0  # radians per second of the body about its x and y
    parts: tuple[tuple[float, Floats, Floats], ...] = ()  # seconds, odometry, clouds of its parts, if known


def misfits(points: float) -> float:
    """Return the probability that clouds of one place do not fit each other, by a cloud's number of surface points.

    Of 584 steps of seven drives, 47 % with 50 to 100 points do not fit, 36 % to 150, 24 % to 200, 4 % to 300, else 1 %.
    """
    return ALONE + 0.4 / (1.0 + (points / 150.0) ** 4)


def likelihood(step: Step, motion: Floats, spread: Floats) -> Floats:
    """Return the likelihood of a step's clouds and map, given the expected motion (..., 3) and covariance (..., 3, 3).

    Either registration may be wrong; two right ones share the errors of the expected motion.
    """
    seen, on_map, o = step.clouds, step.on_map, step.odometry.motion
    if seen is None and on_map is None:
        return np.ones(np.shape(motion)[:-1])
    if seen is None or on_map is None:
        one, fails = (seen, step.fails) if seen is not None else (on_map, MAP_FAILS)
        assert one is not None
        wrong = _wrong(step, seen) if seen is not None else anywhere(one, o)
        likely = (1.0 - fails) * normal(one.motion - motion, one.covariance + spread)
        likely = likely + fails * wrong
    else:
        L, M = seen.covariance, on_map.covariance
        gap = on_map.motion - seen.motion
        gap[2] = wrap_angle(float(gap[2]))
        gain = L @ np.linalg.inv(L + M)
        fused = normal(seen.motion + gain @ gap - motion, L - gain @ L + spread)
        l_right, l_wrong = normal(seen.motion - motion, L + spread), _wrong(step, seen)
        m_right, m_wrong = normal(on_map.motion - motion, M + spread), anywhere(on_map, o)
        likely = (1.0 - step.fails) * (1.0 - MAP_FAILS) * normal(gap, L + M) * fused
        likely = likely + (1.0 - step.fails) * MAP_FAILS * l_right * m_wrong
        likely = likely + step.fails * ((1.0 - MAP_FAILS) * l_wrong * m_right + MAP_FAILS * l_wrong * m_wrong)
    return np.asarray(likely if seen is None else likely * (step.alone if step.apart else 1.0 - step.alone))


def _wrong(step: Step, seen: Seen) -> float:
    """Return the density of the clouds' motion if they are registered wrongly: near one of its starts."""
    density = anywhere(seen, step.odometry.motion)
    return density if step.start is None else 0.5 * (density + anywhere(seen, step.start))


def registered_rightly(step: Step, motion: Floats, spread: Floats) -> float:
    """Return the probability that a step's clouds, which it has, are registered rightly.

    ``motion`` (3,) is expected, with covariance ``spread`` (3, 3).
    """
    assert step.clouds is not None
    seen = step.clouds
    rightly = (1.0 - step.fails) * float(normal(seen.motion - motion, seen.covariance + spread))
    return rightly / (rightly + step.fails * _wrong(step, seen))


def at_once(step: Step, covariance: Floats) -> float:
    """Return the likelihood that clouds left odometry's motion at one moment: in another part of the step both agree.

    It is 1 without parts. A body that is carried, or whose wheels slip, leaves odometry's motion gradually.
    """
    gaps = [between(odometry, clouds) for _, odometry, clouds in step.parts]
    squares = [float(gap @ np.linalg.solve(covariance, gap)) for gap in gaps]
    return math.exp(-0.5 * min(squares, default=0.0))


def of_several_places(step: Step) -> float:
    """Return the likelihood of a step's clouds and map if both are registered arbitrarily."""
    likely = 1.0
    for seen in (step.clouds, step.on_map):
        likely *= 1.0 if seen is None else anywhere(seen, step.odometry.motion)
    return likely if step.clouds is None else likely * (_APART if step.apart else 1.0 - _APART)


def anywhere(seen: Seen, start: Floats) -> float:
    """Return the density of a wrong registration about the motion (3,) where it started: Student's t, one dof.

    It is as uncertain as a right one, so where clouds show nothing, neither is favoured much.
    """
    gap = np.append(seen.motion[:2] - start[:2], wrap_angle(float(seen.motion[2] - start[2])))
    C = np.diag(ANYWHERE**2) + seen.covariance
    square = float(gap @ np.linalg.solve(C, gap))
    return 1.0 / (math.pi**2 * math.sqrt(float(np.linalg.det(C))) * (1.0 + square) ** 2)


def normal(gap: Floats, covariance: Floats) -> Floats:
    """Return the density of gaps (..., 3) between planar motions."""
    x, y, turn = gap[..., 0], gap[..., 1], (gap[..., 2] + math.pi) % (2.0 * math.pi) - math.pi
    (xx, xy, xt), (_, yy, yt), (_, _, tt) = np.moveaxis(covariance, (-2, -1), (0, 1))
    # by cofactors, as separate inverses for every two lags would take ten times as long
    a, b, c = yy * tt - yt * yt, xt * yt - xy * tt, xy * yt - xt * yy
    det = xx * a + xy * b + xt * c
    square = a * x * x + (xx * tt - xt * xt) * y * y + (xx * yy - xy * xy) * turn * turn
    square = (square + 2.0 * (b * x * y + c * x * turn + (xy * xt - xx * yt) * y * turn)) / det
    return np.asarray(np.exp(-0.5 * square) / np.sqrt((2.0 * math.pi) ** 3 * det))


def density(C: Floats, covariance: Floats) -> float:
    """Return the density of a planar motion ``C`` (3,) about zero, by a covariance (3, 3)."""
    return float(normal(C, covariance))


def unsure(step: Step) -> Floats | None:
    """Covariance (L, L, 3, 3) of odometry between each pair of lags, where there are holes in it; None without."""
    if step.unsure is None or float(step.unsure.max()) < _WHOLE:
        return None
    squares = step.unsure[0][:, None] ** 2 + step.unsure[1] ** 2
    return hidden_by(np.sqrt(squares))


def hidden_by(seconds: Floats) -> Floats:
    """Covariance (..., 3, 3) of motions by accelerations that odometry missed; ``seconds`` (...) is in seconds^2."""
    return np.asarray(np.square(seconds)[..., None, None] * np.diag(_ACCELERATIONS**2))
