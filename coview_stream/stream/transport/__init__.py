"""Zenoh sessions, keys and queries; the in-memory transport of tests."""
