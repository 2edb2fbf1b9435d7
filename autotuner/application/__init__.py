"""The front without HTTP: loops, tuning runs, analysis, the compute pool. It leaves devices to `control`."""
