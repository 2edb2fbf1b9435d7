"""The asynchronous runtime: ticker, controller, recorder, plugins. No HTTP, no formulas."""
