"""What is computed in a worker process: the analysis of a record, early gains, the learned model."""
