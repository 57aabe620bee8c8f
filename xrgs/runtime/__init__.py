"""Handles what concerns the process itself: cores, threads, signals, streams and progress."""
