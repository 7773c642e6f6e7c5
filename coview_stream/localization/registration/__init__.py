"""Registration of a scan to the map, its verification and its covariance."""
