"""Mark of tests that take longest: ``COVIEW_NIGHTLY=1`` runs them, and so does ``COVIEW_SOAK_MINUTES=10 .ci/run``."""

import os

import pytest

nightly = pytest.mark.skipif(not os.environ.get("COVIEW_NIGHTLY"), reason="takes long; COVIEW_NIGHTLY=1 runs it")
