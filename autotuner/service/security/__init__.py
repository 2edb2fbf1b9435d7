"""Access to the service: tokens, roles, limits, loopback, audit."""
