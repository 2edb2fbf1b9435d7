"""What outlives the service: tunings with their recordings and events, and who did what.

Invariants:

1. It only listens: whatever happens to the database, no tuning and no restore waits for it or fails by it.
2. The journal (`autotuner.control.records.journal`) stays the safety net; nothing is restored from here.
"""
