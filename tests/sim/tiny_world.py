"""A village that is simulated in seconds."""

from coview_stream.sim.simulate import SimulationConfig

TINY = SimulationConfig(scene="village", sensor="vlp16", seed=5, size=80.0, length=0.5, density=2.0)
