"""Persistent state: the store, records of leases, locks of devices, the ledger of gains."""
