"""Worker processes, a cluster, and the computations that run there."""
