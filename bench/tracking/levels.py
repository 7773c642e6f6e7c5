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
from scipy.stats import beta, chi2, f

from bench.accuracy.scores import Errors, Track
from bench.harness.rows import number, table
from coview_stream.geometry.arrays import Bools, Floats
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


FIRST_MINUTE = 60.0  # seconds after a fix in which its covariance is judged apart
PARTS = ("first minute", "later")

NOMINAL = tuple(float(p) for p in chi2.cdf([1.0, 4.0, 9.0], 1))  # shares that 1, 2 and 3 sigma promise

AXES: dict[str, tuple[int, ...]] = {
    "x": (0,), "y": (1,), "z": (2,), "roll": (3,), "pitch": (4,), "yaw": (5,),
    "x,y": (0, 1), "x,y,z": (0, 1, 2), "pose": (0, 1, 2, 3, 4, 5),
}  # fmt: skip
"""One axis alone, or several by their squared Mahalanobis distance."""

WITHIN = 0.05  # share by which an observed coverage may differ from the nominal one

Squares = dict[str, dict[str, Floats]]
"""Squared Mahalanobis distances of poses, by part of the time since a fix and by name of the axes."""


def since_fix(track: Track) -> Floats:
    """(N,) seconds since the fix that each pose goes back to, NaN where there is none.

    A fix is the first pose after a search (SEARCHING or LOST); a doubt in between does not end it.
    """
    out = np.full(len(track.stamps), np.nan)
    fixed: float | None = None
    for k, (state, known) in enumerate(zip(track.states, track.tracking, strict=True)):
        if state in ("SEARCHING", "LOST"):
            fixed = None
        elif known:
            fixed = float(track.stamps[k]) if fixed is None else fixed
            out[k] = track.stamps[k] - fixed
    return out


def squares(twist: Floats, covariances: Floats, axes: Sequence[int]) -> Floats:
    """(N,) squared Mahalanobis distances over some axes; infinite where a covariance is none."""
    pick = np.asarray(axes)
    error, cov = twist[:, pick], covariances[:, pick[:, None], pick]
    sane: Bools = np.asarray(np.isfinite(cov).all(axis=(1, 2)) & np.isfinite(error).all(axis=1))
    cov = np.where(sane[:, None, None], cov, np.eye(len(pick)))
    # metres stand beside radians: compare each by its own size
    scale = np.sqrt(np.abs(np.einsum("nii->ni", cov)))
    scale = np.where(scale > 0, scale, 1.0)
    level = cov / (scale[:, :, None] * scale[:, None, :])
    sane &= np.linalg.eigvalsh(level)[:, 0] > 1e-12
    unit, out = (error / scale)[sane], np.full(len(twist), np.inf)
    out[sane] = np.einsum("ni,ni->n", unit, np.linalg.solve(level[sane], unit[:, :, None])[:, :, 0])
    return out


def spread(track: Track, error: Errors) -> Squares:
    """Squared distances of all poses in the ``first minute`` after a fix and ``later``."""
    age = since_fix(track)
    return {
        part: {name: squares(error.twist[mask], track.covariances[mask], axes) for name, axes in AXES.items()}
        for part, mask in zip(PARTS, (age < FIRST_MINUTE, age >= FIRST_MINUTE), strict=True)
    }


def pooled(drives: Sequence[Squares]) -> Squares:
    """Put those of several drives together, and add ``all``, which is both parts."""
    out = {part: {name: np.concatenate([[], *(d[part][name] for d in drives)]) for name in AXES} for part in PARTS}
    return out | {"all": {name: np.concatenate([out[part][name] for part in PARTS]) for name in AXES}}


def coverage(squared: Floats, count: int) -> dict[str, Any]:
    """Shares within 1, 2 and 3 sigma (of ``count`` axes: within the chi-square quantiles of the same shares).

    ``median_nees`` is the median squared distance relative to its nominal value, 1 if the covariance is right; outliers
    do not move it.
    """
    if not len(squared):
        return {"frames": 0, "inside": None, "median_nees": None}
    inside = [float((squared <= limit).mean()) for limit in chi2.ppf(NOMINAL, count)]
    median = float(np.median(squared) / chi2.ppf(0.5, count))
    return {"frames": len(squared), "inside": inside, "median_nees": median if np.isfinite(median) else None}


def shares(squared: Squares) -> dict[str, dict[str, Any]]:
    """Coverage by part and axes."""
    return {
        part: {name: coverage(values, len(AXES[name])) for name, values in by_axes.items()}
        for part, by_axes in squared.items()
    }


def honest(part: dict[str, Any]) -> bool:
    """Whether shares are within :data:`WITHIN` of the promised ones."""
    inside = part["inside"]
    return inside is not None and bool(np.all(np.abs(np.subtract(inside, NOMINAL)) <= WITHIN))


def coverage_table(parts: dict[str, dict[str, Any]]) -> str:
    """Lay out shares in per cent, marked where out of their band; medians of squared distances are 1 if right."""
    columns = (*PARTS, "all")
    head, counts = ["coverage, %", "promised"], ["poses", ""]
    for part in columns:
        head += [part, "median"]
        counts += [str(parts[part]["yaw"]["frames"]), ""]
    rows = []
    for name in AXES:
        row = [name, _percent(NOMINAL)]
        for entry in (parts[part][name] for part in columns):
            mark = "" if entry["inside"] is None or honest(entry) else " !"
            row += [_percent(entry["inside"]) + mark, number(entry["median_nees"], 2)]
        rows.append(row)
    return table(head, [*rows, counts])


def _percent(inside: Sequence[float] | None) -> str:
    return "-" if inside is None else " / ".join(f"{100 * share:.1f}" for share in inside)
