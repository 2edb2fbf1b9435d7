"""Effects of the process, one file each, and the motion of a process that depends on its own PV."""
