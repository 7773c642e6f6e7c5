"""Stamps of clouds against the turns of the lidar, which are even also where the stamps are wrong.

Clouds that become late have wider spaced stamps than the lidar's turns: by a hole where their lag jumps, by stretched
intervals where it grows. So a step's stamps show how probable an increase of the lag is. The lidar's period is measured
from the stamps: frames may be missing, so intervals are multiples of it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from coview_stream.geometry.arrays import Floats

_RATE = 0.01  # relative deviation of a lidar's turns: spinning ones hold their rate to a per cent
_PARTS = np.arange(1.0, 11.0)  # turns between two frames, at most ten: one frame per second from a lidar of 10 Hz
_FASTEST = 0.02  # seconds; no lidar turns faster, but drivers may send parts of a turn
_SHORT = 0.1  # quantile that defines a short interval; shorter ones may be jitter
_BEYOND = 1.5  # times the usual interval, above which a frame is missing
_FEWEST = 50.0  # weight of the prior in intervals: at first no rarer event is known
_LEAST = 0.01  # least share of holes and of jitter, as events have common causes and are not separated further
_BIN = 0.05 / np.sqrt(12.0)  # sigma of a lag known to a twentieth of a second


class StepStamps(NamedTuple):
    """Stamp intervals within a step, and the usual ones."""

    seconds: Floats  # (N,) intervals
    period: float  # of the lidar, seconds
    sigma: float  # of an interval about a multiple of the period, seconds
    usual: float  # interval, seconds
    holes: float  # share of intervals with a hole
    jitter: float  # share of intervals that are not a multiple

    def allow(self, longer: Floats, sigma: float = _BIN) -> Floats:
        """Return the likelihood (...) of the stamps if the lag grows by ``longer`` (...) seconds, against no change.

        It increases at once, or evenly over the step; ``sigma`` is of ``longer``, seconds.
        """
        flat = np.ravel(longer)
        now = self._likelihood(self.seconds, 0.0)
        at_once = (self._likelihood(self.seconds - flat[:, None], sigma) / now).max(axis=1)
        shares = self.seconds / self.seconds.sum()
        along = self._likelihood(self.seconds - flat[:, None] * shares, sigma * float(shares.max()))
        steady = np.exp(np.log(along / now).mean(axis=1))  # with one common cause
        return np.where(flat == 0.0, 1.0, 0.5 * (at_once + steady)).reshape(np.shape(longer))

    @property
    def hole(self) -> float:
        """Seconds by which the longest interval exceeds the usual one, if frames are missing there; else 0."""
        longest = float(self.seconds.max())
        return longest - self.usual if longest > _BEYOND * self.usual else 0.0

    def stalled(self, lags: Floats) -> Floats:
        """Return the shares (L,) of lags (L,) that explain the hole: shorter by the lag, it is a usual interval."""
        rest = float(self.seconds.max()) - lags
        likely = np.where(rest > _BEYOND * self.usual, 0.0, self._likelihood(rest, _BIN)) * (lags > 0.0)
        return likely / likely.sum() if self.hole and likely.any() else 0.0 * likely

    def _likelihood(self, seconds: Floats, sigma: float) -> Floats:
        """Return the likelihood of intervals, about one for a usual interval."""
        turns = np.maximum(np.round(seconds / self.period), 1.0)
        off = (seconds - turns * self.period) ** 2 / (self.sigma**2 + sigma**2)
        kept = np.where(turns * self.period > _BEYOND * self.usual, self.holes, 1.0 - self.holes)
        return np.asarray(kept * np.exp(-0.5 * off) + self.jitter)


def step_stamps(stamps: Floats, begin: float, end: float) -> StepStamps:
    """Return the stamps of a step from ``begin`` to ``end``, given all newest ``stamps`` (M,), at least two."""
    seconds = np.diff(stamps)
    period, sigma = _period(seconds)
    off = seconds - np.maximum(np.round(seconds / period), 1.0) * period
    usual = float(np.median(seconds))
    holes, jitter = (
        max(_LEAST, float(events.sum() + 1.0) / (len(seconds) + _FEWEST))
        for events in (seconds > _BEYOND * usual, np.abs(off) > 3.0 * sigma)
    )
    within = seconds[(stamps[1:] > begin) & (stamps[1:] <= end)]
    return StepStamps(within, period, sigma, usual, holes, jitter)


def _period(seconds: Floats) -> tuple[float, float]:
    """Return the period of which intervals (N,) are multiples, and the sigma of one about a multiple, seconds."""
    periods = max(float(np.quantile(seconds, _SHORT)) / _PARTS[0], _FASTEST) / _PARTS
    turns = np.maximum(np.round(seconds / periods[:, None]), 1.0)
    periods = np.median(seconds / turns, axis=1)
    off = np.median(np.abs(seconds - turns * periods[:, None]), axis=1)
    sigmas = np.maximum(1.48 * off, _RATE * periods)
    apart = sigmas / periods
    best = int((apart < 1.01 * apart.min()).argmax())  # the longest of several that fit equally
    return float(periods[best]), float(sigmas[best])
