"""Time: the one module that reads the clock, deadlines, limits on calls, and what keeps real time."""
