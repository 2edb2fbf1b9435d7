"""Control of a loop: clock, writes and restores, recovery, gains in the device, verification. No HTTP, no formulas."""
