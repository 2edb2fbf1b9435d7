"""What a command reads and writes: configuration, results, the audit trail."""
