"""The diagnosed record as arrays, its parts, its sensor."""
