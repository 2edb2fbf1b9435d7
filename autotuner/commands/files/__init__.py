"""Input and output of commands: configuration, results, the audit trail."""
