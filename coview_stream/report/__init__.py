"""Reports: errors against the truth, and pictures for people."""

from __future__ import annotations

from coview_stream.report.evaluation import Evaluation, evaluate

__all__ = ["Evaluation", "evaluate"]
