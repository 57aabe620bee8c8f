"""The process that a command runs in: machine, signals, streams, progress."""
