"""relay-autotuner: tune a real control loop with a relay and prove the model on measured data."""
