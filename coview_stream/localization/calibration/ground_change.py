"""Bayes filter for changed ground: dug, filled, piled up or snowed on by decimetres to metres since the survey.

The unknown is h, the height of odometry's frame on the map; it walks by odometry's drift. The ground around the robot
is of one of two kinds: *as surveyed* (S), with most patches at the survey's height for the right h; or *changed* (C),
as in a pit, with patches that tell nothing about h. A robot meets changed ground once in a kilometre and leaves it
within some thirty metres. Each view gives two observations:

* Patches of ground, by their height above the survey's at the registered pose. Under S the likelihood is greatest at
  the h that puts most of them on the survey's ground. Changed ground has another shape than the survey's, or is a copy
  of it at another height, like a level site dug by two metres; a copy becomes less probable by the metre.
* Structure, under both kinds: roofs, crowns and the ends of walls fit the survey only at the right h.

So in a pit with a ramp that is not in the survey, the height follows odometry, or structure where structure shows one;
beyond the pit it follows surveyed ground again. Without evidence all heights stay possible, which the variance shows.
Changed ground is left out of registration: it would shift the robot in height and look like a lean of the sensor.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

import coview_kernels as kernels
from coview_stream.geometry.arrays import Bools, Floats, Floats32, Reals
from coview_stream.geometry.protection import NO_OTHER, RISK, OtherHeights
from coview_stream.geometry.transforms import Pose, pose_from, transform
from coview_stream.localization.calibration.ground_offset import structure_fits
from coview_stream.localization.registration.clouds import STRUCTURE_HEIGHT, LocalMap, RegistrationCloud

# chosen on a simulated town and campus that were dug, filled and snowed on; other sites: `python -m bench ground`
_STEP = 0.1  # metres between the heights
_HEIGHTS = _STEP * np.arange(-40, 41)  # metres above the registered one
_SHIFTS = 0.2 * np.arange(-17, 18)  # metres at which structure is compared
_LEAST, _DEEPEST = 0.35, 5.0  # metres: smaller changes are ground offsets, larger ones do not occur
_DEPTH = 1.5  # metres, mean of a change beyond the least
_SITES = 2e-2  # share of the sites where the robot starts on changed ground
_BECOMES, _ENDS = 1e-3, 0.03  # probability per metre that changed ground starts, and that it ends: sites are small
_COPY = 0.1  # nats per metre against a copy of the survey's ground
_BROKEN = 5.0  # most nats against a copy of the survey's ground that does not move along odometry
_SURE = 0.9  # probability of another height, within half a metre, above which the robot is moved there
_ANEW = 1e-6  # probability per metre that the whole belief is wrong
_START = 0.1  # metres, one sigma of a registered height on ground as surveyed

_PATCH, _FEW = 4.0, 3  # metres; least points of a patch
_INDEPENDENT = 0.1  # observations per patch: ground within a dozen metres is dug together
_SURVEY, _LEAN = 0.07, math.radians(0.5)  # one sigma of a patch's height, metres, and of the cloud's attitude
_CHANGES = ((0.3, 0.5), (1.5, 0.5))  # metres, mean of a change by plants and of one by diggers; shares
_KEPT = np.array([0.3, 0.5, 0.7, 0.85, 0.95, 0.99])  # shares of patches that are as surveyed, under S
_KEPT_PRIOR = np.array([0.02, 0.03, 0.05, 0.1, 0.3, 0.5])  # probabilities of these shares
_ODDS = 4.0  # nats, most evidence of a single patch
_ON_MAP = 0.5  # metres from a point that lies on the map to a map point

# with these, structure of undisturbed sites and of one with half of its buildings gone or new preferred no height
# metres off by more than 4 nats
_STRUCTURE = 0.3  # observations per patch of structure, as for a ground offset
_SEEN = 10.0  # metres of driving over which the same structure stays in view
_BLUR = 5  # shifts averaged, as structure from below differs from structure from above
_VIEWED = 0.07  # metres, one sigma of a height by structure alone
_ELSEWHERE = np.abs(_HEIGHTS) > np.array([[1.5 * _STEP], [_LEAST]])
"""(2, H) heights other than the registered one, by kind: surveyed ground resolves decimetres, structure does not."""


class GroundChange:
    """Belief over the robot's height and the kind of ground around it.

    Attributes:
        share: of the newest scan's ground that was left out as changed.
        metres: median height of that ground above the survey's, if it is most of the ground; 0 otherwise.
    """

    def __init__(self, field: kernels.FieldMap) -> None:
        """Compare the present ground with that of a map's ``field``."""
        self._field = field
        self.clear()

    def clear(self) -> None:
        """Reset, for another place."""
        self.share = self.metres = 0.0
        self._scan: RegistrationCloud | None = None  # the newest, with all of its ground
        self._started = False
        self._T_map_source = np.eye(4)  # of the newest learned registration
        self._h = 0.0  # metres by which registrations have raised the robot above odometry's path
        self._zeros = np.zeros(2)  # values of _h at the zero of the heights, of the kinds and of structure
        self._lowered = 0.0  # metres by which that registration's ground was lowered
        size = np.abs(_HEIGHTS) - _LEAST
        dug = np.where(size > 0.0, np.exp(-size / _DEPTH), 0.0)
        as_surveyed = np.exp(-0.5 * (_HEIGHTS / _START) ** 2)
        self._prior = np.stack([(1.0 - _SITES) * as_surveyed / as_surveyed.sum(), _SITES * dug / dug.sum()])
        self._kinds = self._prior.copy()  # (2, H) probabilities of S and C by the patches
        self._stays = self._prior[0]  # (H,) of S without a part that was C at the last view
        self._structure = np.zeros(len(_HEIGHTS))  # log-likelihood of recently seen structure

    def without_changed(
        self, cloud: RegistrationCloud, T_map_source: Pose, position: Floats, target: LocalMap
    ) -> RegistrationCloud:
        """Return a scan without the ground that differs from the survey's, by its predicted pose (4, 4).

        The first scan has the search's pose and is left whole. ``position`` (3,) is the body's in the scan's frame.
        """
        self._scan, self.share, self.metres = cloud, 0.0, 0.0
        if not self._started:
            return cloud
        patches = _Patches(cloud, T_map_source, position, self._field, target)
        changed = patches.changed(self.probability)
        drop = changed & (cloud.height < STRUCTURE_HEIGHT)  # the ground of a ramp looks like low structure
        ground = drop & ~cloud.above
        if not ground.any():
            return cloud
        self.share = float(ground.sum() / (~cloud.above).sum())
        off = patches.off[ground & np.isfinite(patches.off)]
        if len(off) and self.share > 0.5:
            self.metres = float(np.median(off))
        return replace(
            cloud, points=cloud.points[~drop], above=cloud.above[~drop], height=cloud.height[~drop],
            changed=self.share, dug=patches.dug,
        )  # fmt: skip

    def learn(self, T_map_source: Pose, position: Floats, target: LocalMap, driven: float, variance: float) -> float:
        """Learn from a believed registration of the newest scan; return the metres by which the robot has to rise.

        ``T_map_source`` (4, 4) is the registered pose, ``position`` (3,) the body's in the scan's frame. Since the last
        call the robot has ``driven`` metres, and odometry's height has gained a ``variance``, metres^2.
        """
        if self._scan is None:
            return 0.0
        if self._started:
            # compared here, not where the robot was: along a leaning odometry frame the height changes by itself
            before, now = (transform(T, position[None])[0, 2] for T in (self._T_map_source, T_map_source))
            self._h += float(now - before)
            self._zeros[0] += self._scan.ground_offset - self._lowered  # all earlier ground has this offset, too
            self._walk(driven, variance)
        else:
            self._started, driven = True, 0.0
        self._T_map_source, self._lowered = T_map_source, self._scan.ground_offset
        self._count_on()
        patches = _Patches(self._scan, T_map_source, position, self._field, target)
        same = patches.likelihoods(_HEIGHTS)
        changed = np.full(len(_HEIGHTS), patches.other_shape())
        top = same.max()
        # along odometry a copy moves as surveyed ground would; where that does not fit, it has another depth
        steady = top + math.log(max(self._stays @ np.exp(same - top) / self._stays.sum(), 1e-300))
        copied = np.abs(_HEIGHTS - _HEIGHTS[same.argmax()]) > _LEAST
        changed[copied] = np.maximum(changed[copied], max(steady, top - _BROKEN) - _COPY * driven)
        logs = np.stack([same, changed])
        self._kinds *= np.exp(logs - logs.max())
        self._kinds /= self._kinds.sum()
        self._structure *= math.exp(-driven / _SEEN)
        structure = structure_fits(self._scan, T_map_source, target, _SHIFTS)
        if structure is not None:
            self._structure += _STRUCTURE * np.interp(_HEIGHTS, _SHIFTS, _blurred(structure))
        return self._rise()

    @property
    def probability(self) -> float:
        """Probability that the ground around the robot has been changed."""
        return float(self._belief()[1].sum()) if self._started else 0.0

    @property
    def others(self) -> OtherHeights:
        """Other possible heights than the registered one."""
        if not self._started:
            return NO_OTHER
        off = (self._belief() * _ELSEWHERE).sum(axis=0)
        # probability of each distance or more, from the farthest
        beyond = np.cumsum((off + off[::-1])[: len(off) // 2])
        rare = int((beyond <= 0.5 * RISK).sum())
        reach = abs(_HEIGHTS[rare]) if rare < len(beyond) else 0.0
        return OtherHeights(float(off @ _HEIGHTS**2), float(reach))

    @property
    def alone(self) -> float:
        """Variance that the height gains where only structure holds it, metres^2; see RegistrationCloud.groundless."""
        return self.share**3 * _VIEWED**2

    def _belief(self) -> Floats:
        """Probabilities (2, H) of both kinds and all heights, by patches and structure."""
        belief = self._kinds * np.exp(self._structure - self._structure.max())
        return np.asarray(belief / belief.sum())

    def _rise(self) -> float:
        """Return metres to the probable height, if it is not the registered one, and recentre the heights there."""
        belief = self._belief()
        heights, elsewhere = belief.sum(axis=0), (belief * _ELSEWHERE).sum(axis=0)
        best = int(np.convolve(elsewhere, np.ones(7), mode="same").argmax())
        mode = slice(max(0, best - 5), best + 6)
        if elsewhere[mode].sum() <= _SURE:
            return 0.0
        rise = float(heights[mode] @ _HEIGHTS[mode] / heights[mode].sum())
        self._h += rise
        self._T_map_source = pose_from(np.eye(3), [0.0, 0.0, rise]) @ self._T_map_source
        self._count_on()
        return rise

    def _walk(self, driven: float, variance: float) -> None:
        """Let the height diffuse by a variance, and the kind of ground change, over ``driven`` metres."""
        out = min(0.3, 0.5 * variance / _STEP**2)
        known = (1.0 - 2.0 * out) * self._kinds
        known[:, 1:] += out * self._kinds[:, :-1]
        known[:, :-1] += out * self._kinds[:, 1:]
        becomes, ends, anew = (min(0.5, rate * driven) for rate in (_BECOMES, _ENDS, _ANEW))
        self._stays, changed = known
        new, back = becomes * self._stays, ends * changed
        self._kinds = (1.0 - anew) * (known + np.stack([back - new, new - back])) + anew * self._prior

    def _count_on(self) -> None:
        """Recentre the heights at the present one; those beyond the ends are forgotten."""
        steps = np.round((self._h - self._zeros) / _STEP)
        self._zeros += steps * _STEP
        wanted = np.arange(len(_HEIGHTS)) + steps[:, None].astype(np.int64)
        rows = np.clip(wanted, 0, len(_HEIGHTS) - 1)
        inside = wanted[0] == rows[0]
        self._kinds, self._stays = (np.where(inside, p[..., rows[0]], 0.0) + 1e-12 for p in (self._kinds, self._stays))
        self._structure = self._structure[rows[1]]


class _Patches:
    """Ground patches of a scan at a pose.

    Attributes:
        off: (N,) metres of the scan's points above the survey's ground; NaN where it has none.
        height: (P,) median of ``off`` over the ground of each patch.
        dug: metres from the deepest tenth of the patches up to the survey's ground.
    """

    def __init__(
        self, cloud: RegistrationCloud, T_map_source: Pose, position: Floats, field: kernels.FieldMap, target: LocalMap
    ) -> None:
        points = transform(T_map_source, cloud.points).astype(np.float32)
        here = transform(T_map_source, position[None])[0]
        cell = np.floor((points[:, :2] - here[:2]) / _PATCH).astype(np.int64)
        low = cell.min(axis=0)
        rows, columns = (cell.max(axis=0) - low + 1).tolist()
        self._shape = rows, columns
        self._cell = (cell[:, 0] - low[0]) * columns + cell[:, 1] - low[1]
        self.off: Floats32 = points[:, 2] - kernels.ground_heights(field, points)
        ground = ~cloud.above & (np.abs(self.off) < _DEEPEST)  # False where the survey has no ground
        # where the ground is hidden, the lowest points of walls and crowns look like ground, but lie on map points
        apart = np.flatnonzero(ground & (np.abs(self.off) > _LEAST))
        ground[apart] = kernels.nearest(target.grid, points[apart], _ON_MAP)[0] >= _ON_MAP
        chosen = np.flatnonzero(ground)
        chosen = chosen[np.lexsort((self.off[chosen], self._cell[chosen]))]
        count = np.bincount(self._cell[chosen], minlength=rows * columns)
        self._known = np.flatnonzero(count >= _FEW)
        middle = (np.cumsum(count) - count + count // 2)[self._known]
        self.height = self.off[chosen[middle]].astype(np.float64)
        centre = (np.column_stack(np.divmod(self._known, columns)) + low + 0.5) * _PATCH
        self._sigma = np.hypot(_SURVEY, _LEAN * np.hypot(*centre.T))
        deep = np.sort(self.height)[: max(1, len(self.height) // 10)]
        self.dug = max(0.0, -float(deep[-1])) if len(deep) else 0.0

    def likelihoods(self, heights: Reals) -> Floats:
        """Log-likelihoods (H,) of ground as surveyed if the robot is raised by ``heights`` (H,) metres."""
        logs, _, _ = self._shares(heights)
        top = logs.max(axis=0)
        return np.asarray(top + np.log(_KEPT_PRIOR @ np.exp(logs - top)))

    def other_shape(self) -> float:
        """Log-likelihood of ground that was changed to another shape, at any height."""
        off = np.abs(self.height - np.median(self.height)) if len(self.height) else self.height
        return -_INDEPENDENT * float((off + math.log(2.0)).sum())

    def changed(self, probability: float) -> Bools:
        """Return whether each point lies on a patch that is probably changed, if the pose is right.

        ``probability`` is that of changed ground. A patch without clear evidence follows its neighbours.
        """
        if not len(self.height):
            return np.zeros(len(self._cell), dtype=bool)
        logs, same, other = self._shares(np.zeros(1))
        weights = _KEPT_PRIOR * np.exp(logs[:, 0] - logs.max())
        kept = float(weights @ _KEPT / weights.sum())
        kept += probability * (min(kept, float(_KEPT[0])) - kept)
        odds = math.log(kept / (1.0 - kept)) + np.clip(np.log(same[0] / other[0]), -_ODDS, _ODDS)
        total, known = np.zeros((2, self._shape[0] * self._shape[1]))
        total[self._known], known[self._known] = odds, 1.0
        total, known = (_with_neighbours(each.reshape(self._shape)).ravel() for each in (total, known))
        mean = total / np.maximum(known, 1e-9)
        around = mean[self._known]
        mean[self._known] = np.where(around * odds < 0.0, around + 0.5 * odds, odds)
        return np.asarray((mean < 0.0)[self._cell])

    def _shares(self, heights: Reals) -> tuple[Floats, Floats, Floats]:
        """Log-likelihoods (K, H) for each kept share; densities (H, P) of the patches as surveyed and as changed."""
        at = self.height + heights[:, None]
        z = at / self._sigma
        same = (0.9 * np.exp(-0.5 * z**2) + 0.1 / 3.0 * np.exp(-(z**2) / 18.0)) / (self._sigma * math.sqrt(2 * math.pi))
        other = sum(share * np.exp(-np.abs(at) / size) / (2.0 * size) for size, share in _CHANGES)
        logs = np.stack([np.log(u * same + (1.0 - u) * other).sum(axis=1) for u in _KEPT])
        return _INDEPENDENT * logs, np.maximum(same, 1e-12), np.asarray(other)


def _blurred(values: Floats) -> Floats:
    """Return the means (N,) over windows of :data:`_BLUR` values (N,), mirrored at the ends."""
    return np.convolve(np.pad(values, _BLUR // 2, mode="symmetric"), np.full(_BLUR, 1.0 / _BLUR), mode="valid")


def _with_neighbours(values: Floats) -> Floats:
    """Return the sums (H, W) over each cell and its eight neighbours: exact zeros stay zero, unlike in running sums."""
    rows = np.pad(values, 1)
    rows = rows[:-2] + rows[1:-1] + rows[2:]
    return np.asarray(rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:])
