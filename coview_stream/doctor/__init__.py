"""Checks of the machine, a map, the network and what robots send; each finding says what to do."""
