"""The learned correction, and the static gain that a whole record gives it."""
