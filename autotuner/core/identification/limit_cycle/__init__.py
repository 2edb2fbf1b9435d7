"""Estimators that read a limit cycle: describing function, closed forms, harmonics, online relay."""
