"""The loop process: the operations that it runs, the messages of its front, crash recovery."""
