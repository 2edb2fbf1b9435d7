"""The thesis's learned estimates remade: its data sets, its regressors, its table 5.1, and what they are worth."""
