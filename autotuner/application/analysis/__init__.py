"""From a recording to gains: identification, diagnosis and design together, as a worker computes them."""
