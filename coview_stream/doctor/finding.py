"""One thing that was looked at, what was found, and what to do about it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from coview_stream.stream.client.fleet import printable

Verdict = Literal["ok", "warn", "FAIL"]

_VERDICT, _WHAT = 4, 22  # widths of the first columns


@dataclass(frozen=True)
class Finding:
    """One line of a checkup.

    Attributes:
        verdict: ``ok``; ``warn``: it works, but less well or not for everything; ``FAIL``: it will not work.
        what: was looked at.
        found: what is the case.
        remedy: what to do; may be empty.
        robot: whom it concerns; None if all.
    """

    verdict: Verdict
    what: str
    found: str
    remedy: str = ""
    robot: str | None = None

    def line(self) -> str:
        """One printable line, whatever came from the network."""
        what = f"{self.robot} {self.what}" if self.robot else self.what
        remedy = f"  ({self.remedy})" if self.remedy else ""
        return printable(f"{self.verdict:<{_VERDICT}}  {what:<{_WHAT}}  {self.found}{remedy}").rstrip()

    def to_json(self) -> dict[str, str | None]:
        """Plain data."""
        return {
            "verdict": self.verdict,
            "robot": self.robot,
            "what": self.what,
            "found": self.found,
            "remedy": self.remedy,
        }


def from_error(what: str, error: Exception | str, robot: str | None = None) -> Finding:
    """FAIL with an error's message; messages of this library end with the remedy, after a semicolon."""
    found, _, remedy = " ".join(str(error).split()).partition("; ")
    return Finding("FAIL", what, found, remedy, robot)


def failed(findings: Iterable[Finding]) -> bool:
    """Whether anything will not work."""
    return any(finding.verdict == "FAIL" for finding in findings)
