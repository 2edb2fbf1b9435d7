"""Who may reach the service: tokens, roles, limits, loopback, audit."""
