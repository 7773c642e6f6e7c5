"""Protection levels against the truth: how often an error is larger than its level, with a bound, and what fits them.

Neighbouring poses have nearly the same error. So of each ten metres of driving one pose counts, the first: nearly
independent, as far as the world itself is not what they share.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.special import fdtri
from scipy.stats import beta, f

from bench.accuracy.scores import Errors, Track
from bench.harness.rows import number, table
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.protection import ALERT_DEGREES, ALERT_METRES, RISK, TAILS, axes_of

EVERY = 10.0
"""Metres of driving of which one pose counts."""

ALERT = (ALERT_METRES, ALERT_DEGREES)

TO_ALERT = (2.0, 2.0)
"""Seconds, and metres driven, after which a pose beyond the alert limit has to have been withdrawn."""

PRODUCT = tuple(TAILS.values())
"""The tails that the product has."""

Tails = Sequence[tuple[float, float]]

_HEAVIEST, _LIGHTEST = 2.5, 200.0  # degrees of freedom of a tail: a finite variance; as good as a Gaussian


class Sample(NamedTuple):
    """Poses of which one counts per ten metres: (N, 2) each, of the position and of the rotation.

    Metres and degrees; trace and axes of the covariance are in m2 and rad2. ``doubt`` is the level that was told,
    relative to the one that the covariance alone has: so other tails can be tried on the same drives.
    """

    error: Floats
    doubt: Floats
    trace: Floats
    axes: Floats

    @classmethod
    def of(cls, track: Track, error: Errors, driven: Floats) -> Sample:
        """Pick them from a drive; (N,) metres ``driven`` at each frame."""
        posed = np.flatnonzero(track.tracking)
        rows = posed[np.unique(np.floor(driven[posed] / EVERY), return_index=True)[1]]
        shape = [[axes_of(C[:3, :3]), axes_of(C[3:, 3:])] for C in track.covariances[rows]]
        spread = np.array(shape, dtype=np.float64).reshape(-1, 2, 2)
        errors = np.column_stack([error.metres[rows], error.degrees[rows]])
        sample = cls(errors, np.ones_like(errors), spread[:, :, 0], spread[:, :, 1])
        return sample._replace(doubt=track.levels[rows] / sample.level(PRODUCT))

    @classmethod
    def joined(cls, parts: Sequence[Sample]) -> Sample:
        """Put those of several drives together."""
        return cls(*(np.concatenate([np.empty((0, 2)), *(part[k] for part in parts)]) for k in range(len(cls._fields))))

    def to_json(self) -> dict[str, list[list[float]]]:
        """Return the arrays as lists."""
        return {name: values.tolist() for name, values in self._asdict().items()}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Sample:
        """Undo :meth:`to_json`."""
        return cls(**{name: np.array(values, dtype=np.float64).reshape(-1, 2) for name, values in data.items()})

    def level(self, tails: Tails) -> Floats:
        """(N, 2) metres and degrees that tails of the errors give: factor and degrees of freedom of each."""
        quantiles = [
            factor * np.sqrt(self.trace[:, k] * fdtri(self.axes[:, k], freedom, 1.0 - RISK))
            for k, (factor, freedom) in enumerate(tails)
        ]
        return np.asarray(self.doubt * np.column_stack([quantiles[0], np.degrees(quantiles[1])]))

    def above(self, tails: Tails) -> list[int]:
        """Count the errors that are larger than their level: in metres, in degrees."""
        return [int(count) for count in (self.error > self.level(tails)).sum(axis=0)]


def upper_bound(hits: int, of: int, confidence: float = 0.95) -> float:
    """Return the one-sided upper bound of a share after Clopper and Pearson; 1 of nothing."""
    return 1.0 if hits >= of else float(beta.ppf(confidence, hits + 1, of - hits))


def tail(sample: Sample, part: int) -> tuple[float, float]:
    """Fit the tail of ``part`` (0: metres, 1: degrees): factor and degrees of freedom of the greatest likelihood.

    The model is that of :mod:`coview_stream.geometry.protection`: error^2 / trace, less the factor, is F distributed.
    """
    error = sample.error[:, part] if part == 0 else np.radians(sample.error[:, part])
    square, axes = error**2 / sample.trace[:, part], sample.axes[:, part]

    def unlikely(about: Floats) -> float:
        log_factor, freedom = float(about[0]), float(np.clip(np.exp(about[1]), _HEAVIEST, _LIGHTEST))
        return -float(np.sum(f.logpdf(square * np.exp(-2 * log_factor), axes, freedom) - 2 * log_factor))

    found = [minimize(unlikely, (0.0, np.log(freedom)), method="Nelder-Mead") for freedom in (4.0, 10.0, 40.0)]
    best = min(found, key=lambda each: float(each.fun)).x
    return float(np.exp(best[0])), float(np.clip(np.exp(best[1]), _HEAVIEST, _LIGHTEST))


class Beyond(NamedTuple):
    """One time that poses were given beyond the alert limit: how long until they were withdrawn or right again."""

    seconds: float
    metres: float

    @property
    def misleading(self) -> bool:
        """Whether that took longer, or led further, than allowed."""
        return self.seconds > TO_ALERT[0] or self.metres > TO_ALERT[1]


def beyond_alert_limit(track: Track, error: Errors, driven: Floats) -> list[Beyond]:
    """Return the times that poses were given beyond the alert limit; (N,) metres ``driven`` at each frame."""
    beyond = track.tracking & ((error.metres > ALERT[0]) | (error.degrees > ALERT[1]))
    edges = np.diff(np.r_[False, beyond, False].astype(int))
    out = []
    for begin, end in zip(np.flatnonzero(edges == 1), np.flatnonzero(edges == -1), strict=True):
        last = min(end, len(driven) - 1)  # where it is withdrawn, or the drive's end
        seconds, metres = track.stamps[last] - track.stamps[begin], driven[last] - driven[begin]
        out.append(Beyond(float(seconds), float(metres)))
    return out


def level_table(samples: Mapping[str, Sample]) -> str:
    """Lay out, by name of the group: poses, how many are above their level, the bound, and how wide the levels are."""
    head = ["poses", "one per 10 m", "> level, m", "below, %", "> level, deg", "below, %", "worst / level, m"]
    head += ["worst / level, deg", "level m p50", "p99", "level deg p50", "p99"]
    rows = []
    for name, sample in samples.items():
        count, cells = len(sample.error), [name]
        cells.append(str(count))
        level = sample.level(PRODUCT)
        for hits in sample.above(PRODUCT):
            cells += [str(hits), number(100 * upper_bound(hits, count), 2)]
        worst = (sample.error / level).max(axis=0) if count else [np.nan, np.nan]
        cells += [number(float(each), 2) for each in worst]
        for k, digits in ((0, 2), (1, 1)):
            wide = np.quantile(level[:, k], [0.5, 0.99]) if count else [np.nan, np.nan]
            cells += [number(float(each), digits) for each in wide]
        rows.append(cells)
    return table(head, rows)
