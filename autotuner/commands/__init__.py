"""The commands of the shell interface, one module each."""
