"""Parts of `autotuner tune`: one tuning, a cascade, another loop read along."""
