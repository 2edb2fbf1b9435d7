"""What people are shown of a tuning: curves to draw, what a test will do, and the report as one file.

Invariants: it is pure (no clock, no files, no asyncio), it computes nothing that the core has not, and what
it returns is JSON-ready or text.
"""
