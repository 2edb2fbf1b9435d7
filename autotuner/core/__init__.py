"""The pure core: no asyncio, no clock, no files, no logging. Time is an argument."""
