"""docs/reasons.md has every reason that the code gives for a state."""

from __future__ import annotations

import ast
import re
from pathlib import Path

from coview_stream import RejectionReason, State

ROOT = Path(__file__).resolve().parents[1]
PAGE = " ".join((ROOT / "docs" / "reasons.md").read_text(encoding="utf-8").split())
SOURCES = [
    *(ROOT / "coview_stream" / "localization").rglob("*.py"),
    *(ROOT / "coview_stream" / "stream" / "node").rglob("*.py"),
]
FUNCTIONS = {"_verdict", "_apart", "explain", "_judge", "status_text", "reason", "_silence_reason", "_missing_input"}
CALLS = {
    *("MatchVerdict", "Ruling", "KeyframeEvidence", "_failed"),
    *("restart_search", "_restart_odometry", "explain_loss", "_lose", "on_silence", "engine_restarted"),
}


def texts(node):
    """Constant texts under a node, without docstrings and formats of numbers."""
    skipped = {id(part) for each in ast.walk(node) if isinstance(each, ast.FormattedValue) and each.format_spec
               for part in ast.walk(each.format_spec)}  # fmt: skip
    skipped |= {id(each.value) for each in ast.walk(node) if isinstance(each, ast.Expr)}
    for each in ast.walk(node):
        if isinstance(each, ast.Constant) and isinstance(each.value, str) and id(each) not in skipped:
            yield each.value


def is_reason(node):
    """Whether a node of the syntax tree gives a reason: a function of such, an argument, or an assignment."""
    if isinstance(node, ast.FunctionDef):
        return node.name in FUNCTIONS
    if isinstance(node, ast.Call):
        return getattr(node.func, "attr", getattr(node.func, "id", "")) in CALLS
    if isinstance(node, ast.Assign):
        names = [ast.unparse(target).lower() for target in node.targets]
        return any("reason" in name or name in ("from_there", "by_features", "in_circle") for name in names)
    return isinstance(node, ast.AugAssign | ast.NamedExpr) and "reason" in ast.unparse(node.target)


def reasons(source):
    """Parts of two words or more of the reasons in a module."""
    parts = {text.strip(" ,:;()") for node in ast.walk(ast.parse(source)) if is_reason(node) for text in texts(node)}
    return {part for part in parts if re.search(r"[a-z]{2,} [a-z]", part)}


def test_every_reason_is_documented():
    found = [(path.name, part) for path in SOURCES for part in sorted(reasons(path.read_text(encoding="utf-8")))]
    assert len(found) > 40
    assert [each for each in found if each[1] not in PAGE] == []


def test_every_state_and_cause_is_documented():
    assert [cause.value for cause in RejectionReason if f"| `{cause.value}` |" not in PAGE] == []
    assert [state.value for state in State if f"{state.value}" not in PAGE] == []


def test_reasons_are_found():
    assert reasons('def explain(x):\n    """Two words."""\n    return f"only {x:.2f} of it"') == {"of it"}
    assert reasons('self.restart_search("odometry jumped")') == {"odometry jumped"}
