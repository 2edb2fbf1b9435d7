"""The shipped learned correction: simulated experiments, training, artefacts."""
