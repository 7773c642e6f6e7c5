"""Faults of clouds and odometry, and their probabilities, from the motions that odometry, clouds and map show.

Over a step odometry moves by o, the clouds, registered to each other, by l, and registrations to the map by m. All
three agree if nothing is wrong. Each fault makes them disagree in its own way:

* good: l = o; m = l in all cases, as the map sees the same clouds.
* slip: o is wrong (wheels slip, odometry jumps), l is right, and smooth, as bodies have inertia.
* stopped: o = 0 at any l; l is smooth.
* scaled: l = s o along the path, with the right heading; l is right.
* repeated: l = 0 at any o.
* late: l = o at an earlier time. The lag is constant, or grows unevenly or, with a drifting clock, evenly.
* moved: the sensor was turned or shifted on the body by C, or the clouds come in another frame. Once l = o C, which no
  body does, and from then on l = C^-1 o C.
* mixed: clouds of two places; half of the time l is arbitrary, and most such clouds do not fit each other.

Each registration fails with a small probability and is then arbitrary. A hidden Markov model gives the probabilities:
those before the step, moved by the rates at which faults start and end, times the likelihood of l and m (forward
algorithm). Each lag on a grid is a state; each step starts hypotheses about C, s and a clock's drift; the best stay. A
Kalman filter estimates the lag and the rate of each drifting clock.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.planar import between, compose, inverted
from coview_stream.geometry.transforms import wrap_angle
from coview_stream.localization.tracking.monitor import RejectionReason
from coview_stream.localization.witness.agreement import (
    ANYWHERE,
    Step,
    at_once,
    density,
    hidden_by,
    likelihood,
    normal,
    of_several_places,
    registered_rightly,
    unsure,
)

# rates of the faults
_PER_SECOND = 1e-6  # a driver hangs, a clock drifts away, a second driver starts: once in twelve days of driving
_PAUSE = 60.0  # seconds of a pause that count: drivers and clocks fail while they run or restart
_PER_METRE = 1e-6  # a bolt gives way: once in 1000 km
_FAST = 40.0  # metres per second; no robot is faster, though a wrong registration of clouds may say so
_SLIPS = 0.01  # per metre: wheels slip once in 100 m
_SLIPS_ON = 0.5  # probability that a slip lasts until the next step: wheels grip again within metres
_STALLS = 1e-4  # share of holes in the stamps after which clouds are late by the hole: mostly clouds were dropped
_ENDS = 0.01  # per second: a fault of a driver or clock ends, as watchdogs restart them within minutes
_GROWS_ON = 0.95  # probability that a growing lag grows in the next step: queues fill within some twenty seconds

LAGS = np.arange(0.0, 3.01, 0.05)
"""Lags of clouds, seconds; the first is zero, the last means "as long or longer"."""
_FASTEST = 0.5  # seconds per second, fastest growth of a lag: a driver at half speed
_ALONG, _SIDEWAYS = 0.3, 0.1  # share of the path: wheels that spin or lock, and that skid
_SKID = np.array([0.1, 0.1, math.radians(3.0)])  # in addition, within a step: metres, radians
_JUMPS = ((0.08, 1.0), (0.015, 10.0), (0.005, 100.0))  # odometry may jump by anything, like a restarted estimator
_SLIP_KINDS = (  # share, sigmas, and sigmas per metre of odometry
    (0.5, np.array([0.03, 0.03, math.radians(0.5)]), np.array([_ALONG, 0.0, 0.0])),  # all wheels, along the path
    (0.4, _SKID, np.array([0.2, _SIDEWAYS, 0.0])),  # some wheels, to a side
    *((share, np.minimum(times * ANYWHERE, [math.inf, math.inf, 1.8]), np.zeros(3)) for share, times in _JUMPS),
)
_INERTIA = np.array([2.0, 2.0, math.radians(60.0)])  # sigmas of the acceleration of a body, metres and radians per s^2
_COPY = 1e-6  # probability that another cloud has identical bytes
# in copies with noise 0.9 of the points are unmoved, on a town, a campus and two real runs; in moving clouds 0.01, also
# where rings or a corridor draw the registration to zero motion. Errors of neighbours are correlated
_SAME_POINTS, _SAME_BY_CHANCE, _INDEPENDENT = 0.8, 0.05, 10.0
_CHANGES = (  # sigmas of C: a mount gives way, a frame with another origin, one with other axes
    np.array([0.1, 0.1, math.radians(10.0)]),
    np.array([3.0, 3.0, math.radians(3.0)]),
    np.array([0.1, 0.1, math.radians(100.0)]),
)
_SCALES = 0.5  # sigma of wrong scales of odometry: tyres, gears, units of half the size
_KEPT = 5  # kept hypotheses about each of C, scales and drifting clocks
_EXACT = np.zeros((3, 3))
_NEXT = 0.01  # seconds, step of the numerical derivatives by lag
_ON_BODY = 2.0  # metres, largest shift of a sensor on its mount
_TURNED = math.radians(2.0)  # of C, from which it is called a turn
_NEGLIGIBLE = 1e-6  # probability below which a fault has not started


@dataclass
class _Moved:
    """Hypothesis that clouds have been moved by C (3,), a planar motion, with ``sigmas`` (3,), since a step."""

    weight: float
    C: Floats
    sigmas: Floats

    def expected(self, o: Floats, noise: Floats) -> tuple[Floats, Floats]:
        """Return the clouds' motion (3,) by odometry's, and its covariance (3, 3)."""
        lateral = self.sigmas[2] * float(np.linalg.norm(o[:2])) + self.sigmas[:2] * abs(o[2])
        return compose(compose(inverted(self.C), o), self.C), noise + np.diag([*lateral, 0.0]) ** 2


@dataclass
class _Scaled:
    """Hypothesis that odometry has been out of scale by a factor since a step, with lidar and poses right."""

    weight: float
    scale: float
    sigma: float

    def expected(self, o: Floats, noise: Floats) -> tuple[Floats, Floats]:
        """Return the clouds' motion (3,) by odometry's, and its covariance (3, 3)."""
        along = np.append(o[:2], 0.0) * self.sigma
        return o * [self.scale, self.scale, 1.0], noise + np.outer(along, along)


@dataclass
class _Parting:
    """Hypothesis that the clouds' clock has drifted from odometry's since a step: their lag grows at a constant rate.

    Each step's clouds correct lag and rate (a Kalman filter). On a straight path at constant speed it looks like
    odometry out of scale. Turns separate the two, and so do the stamps, whose correct spacing is the lidar's period.
    """

    weight: float
    lag: float  # seconds
    rate: float  # seconds per second
    covariance: Floats  # (2, 2) of both

    def beyond(self, lag: float) -> float:
        """Return the probability, under the hypothesis, that the clouds are off by over ``lag`` seconds either way."""
        sigma = math.sqrt(2.0) * max(math.sqrt(float(self.covariance[0, 0])), float(LAGS[1]) / 2.0)
        return 1.0 - 0.5 * (math.erf((lag - self.lag) / sigma) + math.erf((lag + self.lag) / sigma))

    def after(self, step: Step, stays: float) -> _Parting:
        """Return the hypothesis after a step, over which it lasts with the probability ``stays``.

        The map and the stamps count in its weight, but do not correct it.
        """
        lag, P, o = self.lag, self.covariance, step.odometry.motion
        later = lag + self.rate * step.seconds
        if max(lag, later) + _NEXT > LAGS[-1]:  # odometry of so long ago is forgotten
            motion = o * [1.0 - self.rate, 1.0 - self.rate, 1.0]
            J = np.outer([-o[0], -o[1], 0.0], [0.0, 1.0])
        else:
            motion = _between_lags(step, lag, later)
            others = (_between_lags(step, lag + start, later + _NEXT) - motion for start in (_NEXT, 0.0))
            by_lag, by_growth = (np.append(d[:2], wrap_angle(float(d[2]))) / _NEXT for d in others)
            J = np.column_stack([by_lag, by_growth * step.seconds])
        noise = step.odometry.covariance
        if step.unsure is not None:
            ends = zip((lag, later), step.unsure, strict=True)
            noise = noise + hidden_by(np.asarray(np.linalg.norm([np.interp(at, LAGS, row) for at, row in ends])))
        spread = noise + J @ P @ J.T
        weight = self.weight * stays * float(likelihood(step, motion, spread))
        state = np.array([lag, self.rate])
        if step.clouds is not None:
            sure = max(registered_rightly(step, motion, spread), _NEGLIGIBLE)
            R = (step.clouds.covariance + noise) / sure + (1.0 / sure - 1.0) * J @ P @ J.T
            gain = np.linalg.solve(J @ P @ J.T + R, J @ P).T
            gap = step.clouds.motion - motion
            gap[2] = wrap_angle(float(gap[2]))
            rest = np.eye(2) - gain @ J
            state, P = state + gain @ gap, rest @ P @ rest.T + gain @ R @ gain.T
        if step.stamps is not None:
            longer, sigma = state[1] * step.seconds, math.sqrt(float(P[1, 1])) * step.seconds
            weight *= float(step.stamps.allow(longer, sigma))
        F = np.array([[1.0, step.seconds], [0.0, 1.0]])
        lag, rate = (F @ state).tolist()
        # over a long pause nothing is known of it, and a clock that is ahead says the same as a right one
        weight *= step.seconds * _FASTEST < LAGS[-1] and lag > -LAGS[1]
        return _Parting(weight, lag, rate, F @ P @ F.T)


def _between_lags(step: Step, before: float, now: float) -> Floats:
    """Return odometry's motion (3,) over a step, late by ``before`` seconds at its start and by ``now`` at its end."""
    ends = (step.path_before, before), (step.path_now, now)
    return between(*(np.array([np.interp(lag, LAGS, column) for column in path.T]) for path, lag in ends))


class Accusation(NamedTuple):
    """A fault that may make poses wrong."""

    cause: RejectionReason
    probability: float  # of all such faults together
    sentence: str
    constant: bool = False  # constant fault of mount or clock, which the calibration can find


@dataclass
class FaultPosterior:
    """Probabilities of the faults."""

    slip: float = 0.0
    repeated: float = 0.0
    mixed: float = 0.0
    stopped: float = 0.0
    steady: Floats = field(default_factory=lambda: np.eye(1, len(LAGS))[0])  # of each constant lag; the first is good
    growing: Floats = field(default_factory=lambda: np.zeros(len(LAGS)))  # of each lag that grows
    moved: list[_Moved] = field(default_factory=list)
    scaled: list[_Scaled] = field(default_factory=list)
    parting: list[_Parting] = field(default_factory=list)
    astray: float = 0.0  # probability that odometry has gone wrong at some step since :meth:`trusted`
    _driven: float = 0.0  # metres by odometry since the scan has been repeated
    _moved_on: float = 0.0  # metres by the clouds since odometry has stood still
    _speed: Floats = field(default_factory=lambda: np.zeros(3))  # of the newest step: m/s, m/s, rad/s with tilting
    _before: tuple[float, Floats, Floats] | None = None  # seconds, odometry and clouds of the previous step

    @property
    def good(self) -> float:
        """Probability that nothing is wrong."""
        return float(self.steady[0])

    @property
    def odometry(self) -> float:
        """Probability that odometry is wrong and the lidar right."""
        return self.slip + sum(h.weight for h in self.scaled)

    @property
    def slipped(self) -> float:
        """Odds that odometry has gone wrong since :meth:`trusted`, between a millionth and a million."""
        right = (1.0 - self.astray) * (1.0 - self.odometry)
        return max(1.0 - right, _NEGLIGIBLE) / max(right, _NEGLIGIBLE)

    @property
    def sensors(self) -> float:
        """Probability of a present fault of the clouds, their clock or mount, or of odometry that has stopped."""
        return 1.0 - self.good - self.odometry

    def add(self, step: Step) -> None:
        """Update the probabilities by a step (see the module)."""
        o, dt = step.odometry.motion, step.seconds
        driven = float(np.linalg.norm(o[:2]))
        noise = step.odometry.covariance
        come, ends = _PER_SECOND * min(dt, _PAUSE), 1.0 - math.exp(-_ENDS * dt)
        good, slip = self.good, self.slip

        def like(motion: Floats, spread: Floats = noise) -> Floats:
            """Return the likelihood of the clouds' and the map's motion, given this expected motion."""
            return likelihood(step, motion, spread)

        anything = of_several_places(step)
        kinds = [(share, np.diag((sigmas + metre * driven) ** 2)) for share, sigmas, metre in _SLIP_KINDS]
        smoother = self._smoother(step)
        slips = smoother * sum(share * float(like(o, noise + spread)) for share, spread in kinds)
        stands = driven < 3.0 * math.sqrt(float(noise[0, 0]))  # so copies look like true clouds
        copy = like(o) if stands else like(np.zeros(3)) * _copy_odds(step)

        # faults that start from the good state or a slip, continue and end
        farther = (
            driven if step.clouds is None else max(driven, min(dt * _FAST, float(np.hypot(*step.clouds.motion[:2]))))
        )
        grips = math.exp(-_SLIPS * farther)  # under each hypothesis
        begins = 1.0 - grips
        new_slip = (begins * good + _SLIPS_ON * slip) * slips
        new_repeated = (come * (good + slip) + (1.0 - ends) * self.repeated) * float(copy)
        new_stopped = 0.0
        if stands:
            new_stopped = (come * (good + slip) + (1.0 - ends) * self.stopped) * float(like(*self._going_on(step)))
        both = 0.5 * (anything + float(like(o)))  # the same place half of the time
        new_mixed = (come * (good + slip) + (1.0 - ends) * self.mixed) * both
        back = (1.0 - _SLIPS_ON) * slip * float(like(o)) + ends * (self.repeated + self.mixed) * anything
        back += ends * self.stopped * float(like(o))

        # lags: all pairs of a previous and a present lag
        motions = between(step.path_before[:, None], step.path_now)
        steady_spread, hidden = noise, unsure(step)
        if hidden is not None:
            steady_spread = noise + hidden[np.arange(len(LAGS)), np.arange(len(LAGS))]
        pairs = like(motions, noise + _grid_spread(o, dt) + (0.0 if hidden is None else hidden))
        np.fill_diagonal(pairs, like(motions.diagonal().T, steady_spread))  # with the same error at both ends
        pairs[0, 0], pairs[-1, -1] = like(o), 0.0
        if step.stamps is not None:
            pairs = pairs * step.stamps.allow(_LONGER)[_LONGER_OF]
        on, to_steady, to_growing = _lag_rates(dt, come)
        if step.stamps is not None:
            on[0, :-1] += _STALLS * step.stamps.holes * step.stamps.stalled(LAGS)[:-1]
        grown = self.growing + np.eye(1, len(LAGS))[0] * good * come
        steady: Floats = grips * (self.steady @ (on * pairs) + self.growing @ (to_steady * pairs))
        growing: Floats = grips * (grown @ (to_growing * pairs))
        steady[0] += back

        # a moved sensor stays moved; the map has to see the move, too, as clouds of bare ground show anything
        stays = grips * (1.0 - ends)
        moved = [replace(h, weight=stays * h.weight * float(like(*h.expected(o, noise)))) for h in self.moved]
        steady[0] += ends * sum(h.weight * float(like(compose(inverted(h.C), o))) for h in self.moved)
        if step.clouds is not None and step.on_map is not None:
            C = between(o, step.clouds.motion)
            L = step.clouds.covariance
            weight = (come + _PER_METRE * driven) * (good + slip)
            weight *= float(np.mean([density(C, L + np.diag(s**2)) for s in _CHANGES]))
            weight *= float(like(step.clouds.motion, _EXACT)) / float(normal(np.zeros(3), step.clouds.covariance))
            weight *= at_once(step, step.clouds.covariance + noise)
            moved.append(_Moved(weight, C, np.sqrt(np.diag(step.clouds.covariance + noise))))
        moved = sorted(moved, key=lambda h: -h.weight)[:_KEPT]

        # nor does a wrong scale of odometry correct itself
        scaled = [replace(h, weight=grips * h.weight * float(like(*h.expected(o, noise)))) for h in self.scaled]
        if step.clouds is not None and not stands:
            scale = float(step.clouds.motion[:2] @ o[:2]) / driven**2
            sigma = math.sqrt(float(step.clouds.covariance[0, 0] + noise[0, 0])) / driven
            h = _Scaled(_PER_METRE * driven * (good + slip) * smoother, scale, sigma)
            h.weight *= min(1.0, sigma * _scale_density(scale)) * float(like(*h.expected(o, noise)))
            scaled.append(h)
        scaled = sorted(scaled, key=lambda h: -h.weight)[:_KEPT]

        # a drifting clock drifts on until it is set, or stays as late as it is
        parting = [h.after(step, stays) for h in self.parting]
        for clock in self.parting:
            at = min(max(round(clock.lag / float(LAGS[1])), 0), len(LAGS) - 2)
            steady[0] += 0.5 * ends * clock.weight * pairs[at, 0]
            steady[at] += 0.5 * ends * clock.weight * pairs[at, at]
        if step.clouds is not None and not stands and 0.0 < 1.0 - scale < _FASTEST:
            new = _Parting(come * (good + slip), 0.0, 0.0, np.diag([0.0, (0.5 * _FASTEST) ** 2]))
            parting.append(new.after(step, 1.0))
        parting = sorted(parting, key=lambda h: -h.weight)[:_KEPT]

        others = new_slip + new_repeated + new_mixed + new_stopped + steady.sum() + growing.sum()
        others += sum(h.weight for h in moved) + sum(h.weight for h in scaled) + sum(h.weight for h in parting)
        longest = float(self.steady[-1] + self.growing[-1])  # predicts nothing, so it neither gains nor loses
        steady[-1] += longest * (1.0 - ends) * others / max(1.0 - longest, 1e-12)
        total = others + longest * (1.0 - ends) * others / max(1.0 - longest, 1e-12)
        self._before = None
        if step.clouds is not None:
            self._before = step.parts[-1] if step.parts else (dt, o, step.clouds.motion)
        self._speed = np.abs(o) / dt + [0.0, 0.0, step.tilting]
        if not (math.isfinite(total) and total > 0.0):
            return
        self.slip, self.repeated, self.mixed = new_slip / total, new_repeated / total, new_mixed / total
        self.stopped = new_stopped / total
        self.suspect(begins if step.clouds is None else self.slip + self.stopped)  # the map's part is no evidence here
        self.steady, self.growing = np.maximum(steady, 0.0) / total, growing / total
        self.moved = [replace(h, weight=h.weight / total) for h in moved]
        self.scaled = [replace(h, weight=h.weight / total) for h in scaled]
        self.parting = [replace(h, weight=h.weight / total) for h in parting]
        if not stands:
            self._driven = self._driven + driven if self.repeated > _NEGLIGIBLE else 0.0
        if step.clouds is not None:
            metres = float(np.linalg.norm(step.clouds.motion[:2]))
            moves = metres > 3.0 * math.sqrt(float(step.clouds.covariance[0, 0]))  # else both stand still and agree
            self._moved_on = self._moved_on + metres if moves and self.stopped > _NEGLIGIBLE else 0.0

    def suspect(self, probability: float) -> None:
        """Add the ``probability`` that odometry has gone wrong in one more step."""
        self.astray += (1.0 - self.astray) * probability

    def unseen(self, metres: float) -> None:
        """Add ``metres`` of odometry that no clouds were compared over."""
        self.suspect(1.0 - math.exp(-_SLIPS * metres))

    def trusted(self) -> None:
        """Take odometry as right so far, as the map has verified a pose by it."""
        self.astray = 0.0

    def forget_speed(self) -> None:
        """Forget the newest step, as the next one does not continue it."""
        self._before, self._speed = None, np.zeros(3)

    def corrected(self, D: Floats, delay: float, factor: float = 1.0) -> None:
        """Follow a calibration that has moved the clouds by ``D`` (3,) and changed delay and scale.

        ``D`` is body <- the body's axes by the earlier calibration, ``delay`` the increase of the delay, seconds,
        ``factor`` the factor on odometry's distances.
        """
        self.scaled = [replace(h, scale=h.scale / factor, sigma=h.sigma / factor) for h in self.scaled]
        for h in self.moved:
            h.C = compose(h.C, inverted(D))
        for parting in self.parting:
            parting.lag = max(parting.lag - delay, 0.0)
        if delay:
            for lags in (self.steady, self.growing):
                shares, place = lags.copy(), np.clip((LAGS - delay) / float(LAGS[1]), 0.0, len(LAGS) - 1.0)
                if lags is self.steady:
                    place[0] = 0.0  # the good state stays good under the new calibration
                below = np.minimum(place.astype(np.int64), len(LAGS) - 2)
                lags[:] = 0.0
                np.add.at(lags, below, (1.0 - place + below) * shares)
                np.add.at(lags, below + 1, (place - below) * shares)

    def rescaled(self, risk: float) -> tuple[float, float] | None:
        """Return odometry's wrong scale and its sigma once it is certain, and count it as corrected; None before."""
        share = sum(h.weight for h in self.scaled)
        if share < 1.0 - risk:
            return None
        best = max(self.scaled, key=lambda h: h.weight)
        self.scaled = []
        self.steady[0] += share
        return best.scale, best.sigma

    def accusation(self, metres: float, radians: float, risk: float) -> Accusation | None:
        """Return the likeliest fault that puts poses off beyond a level; None if all together are below ``risk``."""
        wrong: list[Accusation] = []
        if self._driven > metres:
            words = f"the lidar repeats itself: no motion between clouds while odometry drives {self._driven:.1f} m"
            wrong.append(Accusation(RejectionReason.REPEATED, self.repeated, words))
        if self._moved_on > metres:
            words = f"odometry stands still while the lidar moves by {self._moved_on:.1f} m"
            wrong.append(Accusation(RejectionReason.STOPPED, self.stopped, words))
        words = "clouds do not fit each other: they are of more than one place, as of two drivers on one key"
        wrong.append(Accusation(RejectionReason.MIXED, self.mixed, words))
        late = self.steady + self.growing
        off = LAGS * float(np.linalg.norm(self._speed[:2])) > metres
        off |= LAGS * self._speed[2] > radians
        if off.any():
            lag, share = float(LAGS[off][late[off].argmax()]), float(late[off].sum())
            grows = " and more and more" if self.growing[off].sum() > 0.5 * share else ""
            words = f"clouds are {lag:.1f} s older than their stamps{grows}"
            wrong.append(Accusation(RejectionReason.CLOCK, share, words, True))
        speed, turning = float(np.linalg.norm(self._speed[:2])), float(self._speed[2])
        if self.parting:
            longest = min(metres / max(speed, 1e-9), radians / max(turning, 1e-9))  # longest lag of a right pose
            share = sum(h.weight * h.beyond(longest) for h in self.parting)
            best = max(self.parting, key=lambda h: h.weight)
            grows = " and more and more" if best.rate > 0.0 else ""
            words = f"clouds are {max(best.lag, 0.0):.1f} s older than their stamps{grows}"
            wrong.append(Accusation(RejectionReason.CLOCK, share, words))
        for h in self.moved:
            shift, turn = float(np.linalg.norm(h.C[:2])), abs(float(h.C[2]))
            if shift > metres or turn > radians:
                words = f"clouds jumped by {shift:.1f} m as no body moves: of another driver on their key?"
                if turn > _TURNED:
                    words = f"the sensor was turned by {math.degrees(turn):.0f} degrees on its mount"
                wrong.append(Accusation(RejectionReason.MOUNT, h.weight, words, shift < _ON_BODY))
        total = sum(each.probability for each in wrong)
        if total < risk:
            return None
        return max(wrong, key=lambda each: each.probability)._replace(probability=total)

    def _going_on(self, step: Step) -> tuple[Floats, Floats]:
        """Return the motion (3,) of a body that continues to move like its clouds, and its covariance (3, 3)."""
        if self._before is None:
            return step.odometry.motion, np.diag(ANYWHERE**2)
        seconds, _, seen = self._before
        inertia, share = _INERTIA * 0.5 * (seconds + step.seconds) * step.seconds, step.seconds / seconds
        covariance = np.zeros((3, 3)) if step.clouds is None else step.clouds.covariance
        return seen * share, np.diag(inertia**2) + covariance * share**2

    def _smoother(self, step: Step) -> float:
        """Return the likelihood ratio by which the clouds' motion is smoother than odometry's, since the last step."""
        if self._before is None or step.clouds is None:
            return 1.0
        exponent, (seconds, driven, seen) = 0.0, self._before
        for part in step.parts or ((step.seconds, step.odometry.motion, step.clouds.motion),):
            inertia = (_INERTIA * 0.5 * (seconds + part[0])) ** 2
            spread = inertia + np.diag(step.clouds.covariance) * (seconds**-2 + part[0] ** -2)
            jump = part[1] / part[0] - driven / seconds, part[2] / part[0] - seen / seconds
            exponent += 0.5 * float(((jump[0] ** 2 - jump[1] ** 2) / spread).sum())
            seconds, driven, seen = part
        return math.exp(min(max(exponent, -30.0), 30.0))


_LONGER = float(LAGS[1]) * np.arange(1.0 - len(LAGS), len(LAGS))
_LONGER_OF = np.arange(len(LAGS))[None] - np.arange(len(LAGS))[:, None] + len(LAGS) - 1
"""Seconds by which lags increase, and their index for each pair of a previous and a present lag."""


def _scale_density(scale: float) -> float:
    return math.exp(-0.5 * ((scale - 1.0) / _SCALES) ** 2) / (_SCALES * math.sqrt(2.0 * math.pi))


def _copy_odds(step: Step) -> float:
    """Return the likelihood ratio of a step's points, for copies of the earlier cloud against a new cloud."""
    if step.copied or step.same is None:
        return 1.0 / _COPY if step.copied else 1.0
    share = step.same * math.log(_SAME_POINTS / _SAME_BY_CHANCE)
    share += (1.0 - step.same) * math.log((1.0 - _SAME_POINTS) / (1.0 - _SAME_BY_CHANCE))
    return math.exp(_INDEPENDENT * share)


def _grid_spread(o: Floats, dt: float) -> Floats:
    """Covariance (3, 3) of a motion between lags of the grid, by the grid's resolution."""
    return np.diag((o / dt * (LAGS[1] - LAGS[0])) ** 2 / 6.0)


def _lag_rates(dt: float, come: float) -> tuple[Floats, Floats, Floats]:
    """Return the transitions (L, L) between constant lags, from growing to constant ones, and among growing ones.

    The first row of the constant ones is the good state, from which any lag may start.
    """
    n, ends = len(LAGS), 1.0 - math.exp(-_ENDS * dt)
    steady = (1.0 - ends) * np.eye(n)
    steady[1:, 0] = ends
    steady[0] = come / (n - 2)
    steady[0, -1] = 0.0  # longer ones only arise by growing
    steady[0, 0] = 1.0 - 2.0 * come
    most = max(1, round(_FASTEST * dt / float(LAGS[1] - LAGS[0])))
    growth = np.triu(np.tri(n, k=most)) / (most + 1)
    growth[:, -1] += 1.0 - growth.sum(axis=1)
    return steady, (1.0 - _GROWS_ON) * np.eye(n), _GROWS_ON * growth
