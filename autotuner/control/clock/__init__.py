"""Time: the one module that reads the clock, deadlines, timeouts of calls, and real-time support."""
