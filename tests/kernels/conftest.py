from collections.abc import Callable

import pytest

from coview_kernels import mapped


@pytest.fixture
def windows(monkeypatch: pytest.MonkeyPatch) -> Callable[[int, int], None]:
    """Sets the bytes from which an array of a file is used by windows, and the bytes of a window."""

    def of_size(large: int, window: int) -> None:
        monkeypatch.setattr(mapped, "LARGE", large)
        monkeypatch.setattr(mapped, "WINDOW", window)

    return of_size
