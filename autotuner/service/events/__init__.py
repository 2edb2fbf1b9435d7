"""Live events of a tuning: server-sent events, broadcast, notifications."""
