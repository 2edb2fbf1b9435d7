"""What `autotuner tune` does: one tuning, a cascade, another loop read along."""
