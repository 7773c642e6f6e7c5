"""When something regular is due. Pure: the time is given, so that a test can play it."""

from __future__ import annotations


class Metronome:
    """Absolute deadlines: what takes long delays one beat, not all the later ones.

    Args:
        rate: beats per second.
        now: local time in seconds; the first beat is due at once.
        slack: seconds by which it may be behind and still catch up.
    """

    def __init__(self, rate: float, now: float, slack: float = 0.0) -> None:
        self.period = 1.0 / rate
        self.slack = slack
        self.due = now

    def remaining(self, now: float) -> float:
        """Seconds until the next beat, 0 if it is due."""
        return max(0.0, self.due - now)

    def beat(self, now: float) -> bool:
        """Whether a beat is due; if so, it has been taken. After a pause of the machine go on, do not catch up."""
        if now < self.due:
            return False
        self.due += self.period
        if now > self.due + self.slack:
            self.due = now + self.period
        return True
