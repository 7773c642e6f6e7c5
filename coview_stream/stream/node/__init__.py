"""The node: sessions of robots, engines in processes of their own, poses at 10 Hz."""
