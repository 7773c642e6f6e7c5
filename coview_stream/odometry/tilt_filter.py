"""Tilt of lidar odometry against gravity as a slowly changing state: a Kalman filter over the up direction.

Registration gives each frame a roll and a pitch in its local map; walls are vertical there and the ground has a
normal. Directions near z are given by their x and y, in the axes of the local map after all turns so far. For frame k,
two numbers each (radians):

    d_k = d_{k-1} + drift          of the local map; drift ~ N(0, 0.2^2 N)
    n_k ~ N(0, N)                  of this frame in the local map: registration's error, forgotten with the frame
    b_k = phi b_{k-1} + ...        of the walls: phi = exp(-metres / 10), variance min(kappa tr(C_k) / 2, (2 deg)^2)
    w_k ~ N(0, kappa C_k)          of the walls, different in each frame; C_k by their number and directions
    s_k = psi s_{k-1} + v_k        slope of the ground; v_k ~ N(0, Q), and psi^2 = 1 - Q / (4 deg)^2 keeps it near level
    m_k ~ N(0, M)                  true motion of the body since the last frame: 2 degrees in 0.1 s, no heavy tail

    up by walls    z_b = d + n + b + w
    up by ground   z_s = d + n + s
    tilted since   z_m = n + m     the last frame, by its reported pose

The filter removes d from the odometry frame, slowly, and n from this frame alone. So a frame's jitter is that of the
better witness: where registration has 0.03 degrees and walls 1, n stays 0; where rings on bare ground keep registration
fixed while the robot shakes, walls and ground outvote it.

The variances are learnt from three witnesses of one direction (Gray and Allan's three-cornered hat): N, Q and kappa are
estimated from the innovations, each as the sum of its squared shares over its redundancy (Foerstner's variance
components), fading over 60 frames. n, v and w have Student's t distribution with 4 degrees of freedom: a kerb taken for
the ground, or a parked lorry for a wall, is outvoted in that frame. So is a registration that turns a covered sensor
over by 27 degrees: it may be that wrong, but the body cannot be that fast. Such a likelihood has several maxima, so the
search starts twice, with n as usual and with n an outlier.

Per frame the odometry frame turns by at most 1.5 times the presumed drift of the local map, so that late knowledge of
gravity (after a first frame on a slope) enters slowly, without a jump of the pose.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import exp_so3
from coview_stream.odometry.gravity import SLOPE, Plumb

# set by hand
_DRIFT = 0.2  # of the local map per frame, as a share of the frame's error
_LEAST_DRIFT = float(np.radians(0.005))  # lower limit: 0.15 degrees in 100 s at 10 Hz without a preferred direction
_MAX_TURN = 1.5  # sigmas of that drift, largest turn of the odometry frame per frame
_FRAME_TILT = float(np.radians(0.2))  # initial sigma of a frame's tilt by registration
_SLOPE_STEP = float(np.radians(0.5))  # likewise of the change of the ground's slope per frame
_WALL_METRES = 10.0  # over which the walls' error stays the same
_NO_WALLS = float(np.radians(2.0))  # sigma of the walls' common error, without walls
_LEAST = float(np.radians(0.01))  # least sigma
_LEAST_KAPPA = 1e-3
_GROUND_FIT = float(np.radians(0.02))  # sigma of the plane's fit alone
_FREEDOM = 4.0  # of Student's t
_ROUNDS = 5  # of reweighting
_STARTS = ((1.0, 1.0, 1.0), (1e-4, 1.0, 1.0))  # initial weights of n, v and w
_FADE = 1.0 - 1.0 / 60.0  # memory per frame
_PRIOR = 2.0  # degrees of freedom of the prior: one frame's

_EYE, _ZERO = np.eye(2), np.zeros((2, 2))
_MAP, _BIAS, _SLOPES = slice(0, 2), slice(2, 4), slice(4, 6)  # rows of the state
_OF_STATE = np.block([[_EYE, _EYE, _ZERO], [_EYE, _ZERO, _EYE], [_ZERO, _ZERO, _ZERO]])
_OF_FRAME = np.vstack([_EYE, _EYE, _EYE])
_OF_WALLS = np.vstack([_EYE, _ZERO, _ZERO])
_OF_GROUND = np.vstack([_ZERO, _EYE, _ZERO])
_OF_BODY = np.vstack([_ZERO, _ZERO, _EYE])


@dataclass(frozen=True)
class Since:
    """Tilt of a frame's body z axis against that of the previous frame."""

    tilt: Floats  # (2,) difference of the axes' x and y in the level frame
    sigma: float  # of the body's tilt meanwhile, radians


@dataclass
class _Variance:
    """A learnt variance: squared shares over their redundancy, fading."""

    value: float
    least: float

    def __post_init__(self) -> None:
        self._squares, self._redundancy = _PRIOR * self.value, _PRIOR

    def learn(self, squares: float, redundancy: float) -> None:
        """Add one frame's squares, in units of the present variance, and their redundancy."""
        self._squares = _FADE * self._squares + self.value * squares
        self._redundancy = _FADE * self._redundancy + max(0.0, redundancy)
        self.value = max(self.least, self._squares / self._redundancy)


class TiltFilter:
    """Kalman filter over the tilt of the local map, the walls' error and the ground's slope (see the module)."""

    def __init__(self, sigma: float) -> None:
        """Start with an up direction of ``sigma`` radians."""
        self._x = np.zeros(6)
        self._P = np.diag(np.repeat([sigma**2, _NO_WALLS**2, SLOPE**2], 2))
        self._frame = _Variance(_FRAME_TILT**2, _LEAST**2)
        self._slope = _Variance(_SLOPE_STEP**2, _LEAST**2)
        self._kappa = _Variance(1.0, _LEAST_KAPPA)
        self._first = True

    @property
    def frame_tilt(self) -> float:
        """One sigma of a frame's tilt by registration, radians."""
        return float(np.sqrt(self._frame.value))

    def restart(self) -> None:
        """Forget the walls and the ground, as the robot is elsewhere; the up direction stays."""
        tilt = self._P[_MAP, _MAP] + self._frame.value * _EYE
        self._x[2:] = 0.0
        self._P = np.diag(np.repeat([0.0, _NO_WALLS**2, SLOPE**2], 2))
        self._P[_MAP, _MAP] = tilt
        self._first = True

    def expected(self, plumb: Plumb, sigma: float) -> Floats:
        """Return the tilt (2,) of a frame with a guessed pose of ``sigma`` radians, without learning."""
        x, P, slope = self._predicted(plumb, 0.0)
        return self._split(x, P, plumb, sigma**2, slope)[0]

    def update(self, plumb: Plumb, metres: float, since: Since | None = None) -> Floats:
        """Add a registered frame, ``metres`` and ``since`` the previous one; return its tilt n (2,), radians."""
        x, P, slope = self._predicted(plumb, metres)
        frame = 0.0 if self._first else self._frame.value
        tilt, self._x, self._P, learnt = self._split(x, P, plumb, frame, slope, since)
        if not self._first:
            for variance, (squares, redundancy) in zip((self._frame, self._slope, self._kappa), learnt, strict=True):
                variance.learn(squares, redundancy)
        self._first = False
        return tilt

    def turn(self) -> Floats:
        """Return the next turn (2,) of the odometry frame, and subtract it from the state."""
        tilt = self._x[_MAP].copy()
        most = _MAX_TURN * self._drift()
        tilt *= min(1.0, most / max(float(np.linalg.norm(tilt)), 1e-12))
        self._x[_MAP] -= tilt
        return tilt

    def _drift(self) -> float:
        """Return one sigma of the local map's drift per frame, radians."""
        return max(_LEAST_DRIFT, _DRIFT * self.frame_tilt)

    def _predicted(self, plumb: Plumb, metres: float) -> tuple[Floats, Floats, float]:
        """Return state and covariance after ``metres``, before v, and v's variance."""
        x, P = self._x.copy(), self._P.copy()
        walls = _NO_WALLS**2
        if plumb.walls is not None:
            walls = min(walls, self._kappa.value * float(np.trace(plumb.covariance)) / 2.0)
        if self._first:
            P[_BIAS, _BIAS] = walls * _EYE
            return x, P, 0.0
        phi = np.exp(-metres / _WALL_METRES)
        psi = np.sqrt(max(0.0, 1.0 - self._slope.value / SLOPE**2))
        change = np.repeat([1.0, phi, psi], 2)
        x, P = change * x, change[:, None] * P * change
        P[_MAP, _MAP] += self._drift() ** 2 * _EYE
        P[_BIAS, _BIAS] += walls * (1.0 - phi**2) * _EYE
        return x, P, self._slope.value

    def _split(
        self, x: Floats, P: Floats, plumb: Plumb, frame: float, slope: float, since: Since | None = None
    ) -> tuple[Floats, Floats, Floats, list[tuple[float, float]]]:
        """Divide the innovation among the state and the new errors n, v and w, without outliers.

        Returns:
            n (2,), the state and its covariance, and for n, v and w the squares and redundancy to learn from.
        """
        y, rows = plumb.rows()
        y = np.concatenate([y, np.zeros(2) if since is None else since.tilt])
        rows = rows if since is None else np.concatenate([rows, [4, 5]])
        errors = [frame * _EYE, slope * _EYE, self._kappa.value * plumb.covariance]
        ways = [_OF_FRAME[rows], _OF_GROUND[rows], _OF_WALLS[rows]]
        H, body = _OF_STATE[rows], _OF_BODY[rows]
        shake = 0.0 if since is None else since.sigma**2
        normal = H @ P @ H.T + _GROUND_FIT**2 * ways[1] @ ways[1].T + shake * body @ body.T
        innovation = y[rows] - H @ x
        least = np.inf
        for start in _STARTS if since is not None else _STARTS[:1]:
            trial = _reweighted(innovation, normal, errors, ways, start)
            if trial[0] < least:
                least, inverse, gain, wide, shares, rest_of = trial
        cross = P @ H.T
        cross[_SLOPES] += wide[1] @ ways[1].T
        P = P.copy()
        P[_SLOPES, _SLOPES] += wide[1]
        P -= cross @ inverse @ cross.T
        learnt = [
            (_in_units_of(C, np.outer(share, share)), 2.0 - _in_units_of(C, rest))
            if J.any() and C.any()
            else (0.0, 0.0)
            for C, share, rest, J in zip(wide, shares, rest_of, ways, strict=True)
        ]
        return shares[0], x + cross @ gain, 0.5 * (P + P.T), learnt


def _reweighted(
    innovation: Floats, normal: Floats, errors: list[Floats], ways: list[Floats], weights: tuple[float, ...]
) -> tuple[float, Floats, Floats, list[Floats], list[Floats], list[Floats]]:
    """Find a maximum of the likelihood of an innovation (K,) with several error sources (EM), from ``weights``.

    The innovation is the sum of a ``normal`` part, covariance (K, K), and errors with Student's t distribution, (2, 2)
    covariances ``errors``, all zero for none, and (K, 2) Jacobians ``ways``. ``weights`` divide their covariances at
    first.

    Returns:
        Minus the log-likelihood up to a constant, the innovation's inverse covariance, its product with the innovation,
        and for each error its weighted covariance, its share (2,) and its remaining covariance.
    """
    for _ in range(_ROUNDS):
        wide = [C / weight for C, weight in zip(errors, weights, strict=True)]
        total = normal + sum(J @ C @ J.T for J, C in zip(ways, wide, strict=True))
        inverse = np.asarray(np.linalg.inv(total), dtype=np.float64)
        gain = inverse @ innovation
        shares = [C @ J.T @ gain for J, C in zip(ways, wide, strict=True)]
        rest_of = [C - C @ J.T @ inverse @ J @ C for J, C in zip(ways, wide, strict=True)]
        weights = tuple(
            (_FREEDOM + 2.0) / (_FREEDOM + _in_units_of(C, np.outer(share, share) + rest)) if C.any() else 1.0
            for C, share, rest in zip(errors, shares, rest_of, strict=True)
        )
    cost = 0.5 * float(gain @ normal @ gain)
    for C, share in zip(errors, shares, strict=True):
        if C.any():
            cost += 0.5 * (_FREEDOM + 2.0) * math.log1p(_in_units_of(C, np.outer(share, share)) / _FREEDOM)
    return cost, inverse, gain, wide, shares, rest_of


def upright(tilt: Floats) -> Floats:
    """Return the shortest rotation (3, 3) that takes the direction with x and y ``tilt`` (2,), z up, to z."""
    axis = np.array([tilt[1], -tilt[0], 0.0])
    sine = float(np.linalg.norm(axis))
    return exp_so3(axis * (np.arcsin(min(1.0, sine)) / sine if sine > 0.0 else 1.0))


def _in_units_of(C: Floats, squares: Floats) -> float:
    return float(np.trace(np.linalg.solve(C, squares)))
