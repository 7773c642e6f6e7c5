"""The node: sessions of robots, engines in their own processes, poses at 10 Hz."""
