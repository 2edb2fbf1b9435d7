"""The supervisor of an experiment and the watches that it asks before every write."""
