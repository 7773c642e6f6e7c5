"""Maps over the network: a zenoh server of sites, fetching of sites, and a follower of their changes."""
