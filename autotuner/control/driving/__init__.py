"""The output of one loop: the lease, its states, and the stages that drive it."""
