"""Presentation of a tuning: curves, the plan of a test, and the report as one file.

Invariants: pure (no clock, no files, no asyncio); no computation that the core lacks; results are
JSON-ready or text.
"""
