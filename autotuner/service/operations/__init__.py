"""Running the service: logs, metrics, systemd, links, history, monitored loops."""
