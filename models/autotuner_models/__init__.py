"""What is derived from the tuner and the simulator together: reproductions and trained models."""
