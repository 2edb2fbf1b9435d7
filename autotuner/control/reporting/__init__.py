"""What an operation reports while it runs: events, the log, what was collected."""
