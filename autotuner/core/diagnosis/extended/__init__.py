"""The extended model: the process, the effects in it, and how both are fitted."""
