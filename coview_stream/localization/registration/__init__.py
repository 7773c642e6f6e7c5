"""Registration of a scan to the map, and its covariance."""
