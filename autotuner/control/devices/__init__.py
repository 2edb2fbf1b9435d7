"""The use of a device beyond its driver: retries, confirmed reads, limits, gains, plug-ins."""
