"""Between a command and its terminal: options, messages, results, progress, signals."""
