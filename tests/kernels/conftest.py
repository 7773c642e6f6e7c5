from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import settings

from coview_kernels import mapped

settings.register_profile("deterministic", derandomize=True, database=None, deadline=None, max_examples=60)
settings.load_profile("deterministic")


@pytest.fixture
def windows(monkeypatch: pytest.MonkeyPatch) -> Callable[[int, int], None]:
    """Sets the bytes from which an array of a file is used by windows, and the bytes of a window."""

    def of_size(large: int, window: int) -> None:
        monkeypatch.setattr(mapped, "LARGE", large)
        monkeypatch.setattr(mapped, "WINDOW", window)

    return of_size
