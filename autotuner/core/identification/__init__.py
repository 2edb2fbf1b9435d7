"""Estimators: from a recording to process models with their errors."""
