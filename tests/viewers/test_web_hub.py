"""The hub of the web pages: the newest event of each kind, and nobody waits."""

from __future__ import annotations

import json

import pytest

from coview_stream.viewers.web_sink import MAX_PAGES, WebHub, encode_event


def events(taken):
    """Kinds and data of what a page takes."""
    lines = [block.split(b"\n") for block in taken.split(b"\n\n") if block]
    return [(kind[len(b"event: ") :].decode(), json.loads(data[len(b"data: ") :])) for kind, data in lines]


def test_what_a_page_has_not_taken_is_replaced_by_newer():
    hub = WebHub()
    page = hub.open_page()
    for k in range(10_000):
        hub.publish("pose", "r1", {"k": k})
        hub.publish("pose", "r2", {"k": -k})
    assert events(page.take(0.0)) == [("pose", {"k": 9999}), ("pose", {"k": -9999})]
    assert page.take(0.0) == b""


def test_a_new_page_is_told_what_is_kept():
    hub = WebHub()
    hub.tell_first(lambda: [encode_event("trail", {"points": []})])
    hub.publish("status", "r1", {"state": "LOST"})
    hub.publish("scan", "r1", {}, keep=False)
    assert events(hub.open_page().take(0.0)) == [("trail", {"points": []}), ("status", {"state": "LOST"})]


def test_names_from_the_network_fill_no_memory():
    hub = WebHub()
    page = hub.open_page()
    for k in range(20_000):
        hub.publish("pose", f"r{k}", {})
    assert len(events(page.take(0.0))) == 4000
    assert len(events(hub.open_page().take(0.0))) == 4000


def test_pages_are_limited_and_come_free():
    hub = WebHub()
    pages = [hub.open_page() for _ in range(MAX_PAGES)]
    assert hub.open_page() is None
    hub.close_page(pages[0])
    assert hub.open_page() is not None
    hub.close()
    assert pages[1].closed
    assert pages[1].take(5.0) == b""  # at once
    assert hub.open_page() is None


def test_nan_is_no_event():
    with pytest.raises(ValueError, match="JSON"):
        encode_event("pose", {"x": float("nan")})
