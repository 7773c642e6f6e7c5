"""Checks of the machine, a map, the network and the robots' messages, each with a remedy."""
