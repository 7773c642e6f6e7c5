"""Reports: errors against truth, and pictures that a person can read."""

from __future__ import annotations

from coview_stream.report.evaluation import Evaluation, evaluate

__all__ = ["Evaluation", "evaluate"]
