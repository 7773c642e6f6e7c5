"""Ground offset: height of the present ground, raised by grass or snow, above the survey's.

Registration would put the present ground on the survey's, and so the robot too low by the offset. Structure reveals
this: structure and ground are compared with the map at vertical shifts, and the offset is the difference of their best
shifts. The robot's height then follows structure; where no structure shows a height, the offset is zero.

Most sites have no offset, and structure seen from below differs by centimetres from a survey from above. So two
hypotheses are compared: no offset beyond the survey's error, or one of some decimetres. The more probable one holds, as
their mean would raise every site without an offset. Offsets below two decimetres hardly differ from none. Ground below
the survey's looks like trees that have grown since, which is more probable: little of it is corrected.
"""

from __future__ import annotations

import numpy as np

import coview_kernels as kernels
from coview_stream.geometry.arrays import Floats, Reals
from coview_stream.geometry.transforms import Points, Pose, transform
from coview_stream.localization.registration.clouds import LocalMap, RegistrationCloud

# set by hand on a simulated town and campus with their ground lifted by -0.2, 0 and 0.3 m, and checked on three real
# runs and a real forest plot lifted likewise (docs/tracking.md); no command prints it
_SHIFTS = 0.1 * np.arange(-7, 8)  # metres up at which scans are compared with the map
_OFFSETS = 0.02 * np.arange(-25, 26)  # metres, of the hypotheses
_REACH = 0.5  # metres to a map point
_WIDTH = 0.15  # metres off its plane at which a point is half as good
_POINTS = 400  # of structure and of ground
_PATCH = 4.0  # metres: a patch of structure is one observation
_FEW = 4  # least points of a patch
_CHANCE = 0.1  # share of a patch that fits at any shift
_ANY_HEIGHT = 0.3  # likewise, over shifts of metres
_NONE = 0.98  # prior of no offset: 0.9 left drives through changed campuses (bench tracking) 0.1 m off in height
_NONE_SIGMA, _SIGMA = 0.02, 0.2  # metres, of the two hypotheses
_VIEWED = 0.07  # metres, one sigma of the height difference between structure seen from below and above
_INDEPENDENT = 0.3  # observations per patch: neighbours have common errors
_MEMORY = 0.9  # weight of earlier registrations, from one to the next
_FOLLOWED = 0.25  # share of a change applied per registration, for a smooth height
_STILL, _CHANGED = 0.6, 0.1  # probability that an earlier offset still holds; its sigma, metres

# growth since the survey looks as if the ground had sunk: a nuisance parameter, summed over
_HEIGHTS, _PARTS = 0.1 * np.arange(1, 7), (0.5, 1.0)  # metres of growth, share of the patches
_GROWTHS = np.array([(0.0, 0.0), *((height, part) for height in _HEIGHTS for part in _PARTS)])
_GROWN = 0.5  # prior probability of any growth


class GroundOffset:
    """Estimate of the ground offset at one site, from registrations.

    Attributes:
        metres: the applied offset.
        sigma: one sigma of the offset, metres.
        probability: that the site has an offset.
    """

    def __init__(self) -> None:
        self.restore(0.0)

    def restore(self, metres: float) -> None:
        """Restart; from now on, an earlier offset of this site is a third hypothesis at every accepted place.

        It is the most probable hypothesis until registrations contradict it. An offset near zero adds no hypothesis.
        """
        self._none, self._some = _NONE * _ZERO, (1.0 - _NONE) * _ANY
        if abs(metres) > 2.0 * _NONE_SIGMA:
            near = _normal(_CHANGED, _OFFSETS - np.clip(metres, _OFFSETS[0], _OFFSETS[-1]))
            self._some = _STILL * near + (1.0 - _STILL) * (1.0 - _NONE) * _ANY
            self._none = (1.0 - _STILL) * _NONE * _ZERO
        self.clear()

    def clear(self) -> None:
        """Forget the registrations of the previous place."""
        self._likelihoods, self._views = np.zeros((len(_GROWTHS), len(_OFFSETS))), 0
        self.metres = self._weigh()

    def lower(self, cloud: RegistrationCloud) -> RegistrationCloud:
        """Return a scan with its ground lowered by the offset, onto the survey's."""
        return cloud.lowered(self.metres) if self.metres else cloud

    def learn(self, cloud: RegistrationCloud, T_map_source: Pose, target: LocalMap) -> None:
        """Learn from a believed registration of ``cloud`` (lowered or not) to ``target`` at ``T_map_source`` (4, 4)."""
        likelihoods = log_likelihoods(cloud, T_map_source, target)
        if likelihoods is None:
            return
        self._likelihoods, self._views = _MEMORY * self._likelihoods + _INDEPENDENT * likelihoods, self._views + 1
        # the first registrations are averaged: there is no height to follow yet
        self.metres += max(_FOLLOWED, 1.0 / self._views) * (self._weigh() - self.metres)

    def _weigh(self) -> float:
        """Weigh the hypotheses by the registrations; return the mean of the more probable one, metres."""
        growths = _GROWTH_PRIOR @ np.exp(self._likelihoods - self._likelihoods.max())
        likelihoods = np.convolve(growths, _normal(_VIEWED, _OFFSETS), mode="same")
        offset, none = likelihoods * self._some, likelihoods * self._none
        self.probability = float(offset.sum() / (offset.sum() + none.sum()))
        mean = float(offset @ _OFFSETS / offset.sum()) if self.probability > 0.5 else 0.0
        weights = (offset + none) / (offset + none).sum()
        self.sigma = float(np.sqrt(weights @ (_OFFSETS - mean) ** 2))
        return mean


def log_likelihoods(cloud: RegistrationCloud, T_map_source: Pose, target: LocalMap) -> Floats | None:
    """Return the log-likelihoods (G, 51) of growths and offsets -0.5 to 0.5 m; None without structure or ground."""
    structure = _some(cloud.points[cloud.high])
    ground = _some(cloud.points[~cloud.above])
    if len(structure) < _FEW or len(ground) < _FEW:
        return None
    profile = _fits(ground, T_map_source, target).mean(axis=0)
    k = int(np.clip(profile.argmax(), 1, len(profile) - 2))
    below, here, above = profile[k - 1 : k + 2]  # vertex of a parabola
    bend = below - 2.0 * here + above
    between = 0.5 * (below - above) / bend if bend < 0.0 else 0.0
    level = float(_SHIFTS[k] + (_SHIFTS[1] - _SHIFTS[0]) * np.clip(between, -1.0, 1.0))
    shares = _patch_shares(structure, _fits(structure, T_map_source, target))
    # shift of the structure under each offset: the offset above the best shift of the ground, before it was lowered
    at = _OFFSETS + level - cloud.ground_offset
    still = _between(shares, at)
    rows = [np.log(_CHANCE + (1.0 - q) * still + q * _between(shares, at - g)).sum(axis=0) for g, q in _GROWTHS]
    return np.stack(rows)


def structure_fits(cloud: RegistrationCloud, T_map_source: Pose, target: LocalMap, shifts: Reals) -> Floats | None:
    """Return the log-likelihoods (K,) of a scan's structure at shifts (K,) up; None without structure."""
    structure = _some(cloud.points[cloud.high])
    if len(structure) < _FEW:
        return None
    shares = _patch_shares(structure, _fits(structure, T_map_source, target, shifts))
    return np.asarray(np.log(_ANY_HEIGHT + (1.0 - _ANY_HEIGHT) * shares).sum(axis=0))


def _patch_shares(structure: Points, fits: Floats) -> Floats:
    """Mean fits (P, K) by patch of structure (N, 3) with fits (N, K)."""
    cell = np.floor(structure[:, :2] / _PATCH).astype(np.int64) @ np.array([1 << 20, 1])
    _, patch, count = np.unique(cell, return_inverse=True, return_counts=True)
    shares = np.stack([np.bincount(patch, column, len(count)) for column in fits.T], axis=1) / count[:, None]
    return np.asarray(shares[count >= _FEW])


def _between(profiles: Floats, at: Reals) -> Floats:
    """Interpolate profiles (P, K) over the shifts linearly at shifts (S,): (P, S)."""
    where = np.clip((at - _SHIFTS[0]) / (_SHIFTS[1] - _SHIFTS[0]), 0.0, len(_SHIFTS) - 1.001)
    k = where.astype(np.int64)
    return np.asarray(profiles[:, k] * (1.0 - where + k) + profiles[:, k + 1] * (where - k))


def _fits(points: Points, T_map_source: Pose, target: LocalMap, shifts: Reals = _SHIFTS) -> Floats:
    """Return the fit (N, K) in [0, 1] of points (N, 3) to the map at the vertical shifts (K,)."""
    moved = np.repeat(transform(T_map_source, points)[:, None], len(shifts), axis=1)
    moved[:, :, 2] += shifts
    flat = moved.reshape(-1, 3).astype(np.float32)
    distance, partner = kernels.nearest(target.grid, flat, _REACH)
    paired = distance < _REACH
    off = np.zeros(len(flat))
    normals, _ = target.planes(partner[paired])
    off[paired] = np.einsum("ij,ij->i", flat[paired] - target.points[partner[paired]], normals, dtype=np.float64)
    return np.where(paired, 1.0 / (1.0 + (off / _WIDTH) ** 2), 0.0).reshape(len(points), -1)


def _some(points: Points) -> Points:
    """Return at most ``_POINTS`` points, evenly spread over all in their order."""
    return points[np.linspace(0, len(points) - 1, _POINTS).astype(np.int64)] if len(points) > _POINTS else points


def _normal(sigma: float, at: Reals) -> Floats:
    weights = np.exp(-0.5 * (at / sigma) ** 2)
    return np.asarray(weights / weights.sum())


_GROWTH_PRIOR = np.array([1.0 - _GROWN, *np.full(len(_GROWTHS) - 1, _GROWN / (len(_GROWTHS) - 1))])
_ZERO, _ANY = _normal(_NONE_SIGMA, _OFFSETS), _normal(_SIGMA, _OFFSETS)
