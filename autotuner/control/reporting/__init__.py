"""Reports of a running operation: events, log, counters."""
