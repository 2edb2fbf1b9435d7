"""What outlives the process: the store, records of leases, locks of devices, the ledger of gains."""
