"""Device drivers, one module or package for each protocol, and the tools that check them."""
