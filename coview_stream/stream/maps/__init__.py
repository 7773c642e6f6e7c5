"""Maps over the network: a server of sites on zenoh, fetching of sites, and a follower of their changes."""
