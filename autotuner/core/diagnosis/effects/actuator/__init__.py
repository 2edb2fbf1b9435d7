"""Effects of the actuator, one file each, and the evidence in a record from which their searches start."""
