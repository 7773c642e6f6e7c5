"""Zenoh sessions, keys and queries; the in-memory transport for tests."""
