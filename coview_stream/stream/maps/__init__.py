"""Maps over the network: a server of sites on zenoh, sources that fetch them, and what follows their changes."""
