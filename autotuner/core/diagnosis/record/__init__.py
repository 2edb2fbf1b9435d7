"""What is diagnosed: the record as arrays, its parts, its sensor."""
