"""Effects that are searched together with the process: the process alone is far from the one beside them."""
