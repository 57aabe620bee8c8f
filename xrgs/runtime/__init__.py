"""The process and its surroundings: cores, threads, signals, streams, progress and leases."""
