"""Drivers: a module or package for each way to reach a loop, and the tools that check them."""
