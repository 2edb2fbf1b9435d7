"""PID forms of devices, presets of vendors, and the gains that a device can hold."""
