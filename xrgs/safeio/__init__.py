"""Reads and writes files: typed, bounded and atomic; makes texts safe to show."""
