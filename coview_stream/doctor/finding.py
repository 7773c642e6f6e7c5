"""Findings of the doctor: the check, its result, and the remedy."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Literal

from coview_stream.errors import printable

Verdict = Literal["ok", "warn", "FAIL"]


@dataclass(frozen=True)
class Finding:
    """Result of one check."""

    verdict: Verdict  # ok; warn: it works, with limits; FAIL: it will not work
    what: str  # name of the check
    found: str  # its result
    remedy: str = ""  # action to take; may be empty
    robot: str | None = None  # name of the robot; None for all

    def line(self) -> str:
        """Return one printable line, without control characters that came from the network."""
        name = f"{self.robot} {self.what}" if self.robot else self.what
        remedy = f"  ({self.remedy})" if self.remedy else ""
        return printable(f"{self.verdict:<4}  {name:<22}  {self.found}{remedy}").rstrip()

    def to_json(self) -> dict[str, str | None]:
        """Return plain data, for JSON."""
        return asdict(self)


def from_error(what: str, error: Exception | str) -> Finding:
    """Return a FAIL with an error's message; this package's messages end with a semicolon and the remedy."""
    found, _, remedy = " ".join(str(error).split()).partition("; ")
    return Finding("FAIL", what, found, remedy)


def failed(findings: Iterable[Finding]) -> bool:
    """Whether any finding is a FAIL."""
    return any(finding.verdict == "FAIL" for finding in findings)
