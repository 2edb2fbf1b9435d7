"""Persistent history of the service: tunings with their recordings and events, and the audit.

Invariants:

1. It only listens: whatever happens to the database, no tuning and no restore waits for it or fails by it.
2. The journal (`autotuner.control.records.journal`) stays the safety net; nothing is restored from here.
"""
