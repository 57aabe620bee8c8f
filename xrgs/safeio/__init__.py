"""Reads files that anybody may have written, and writes files atomically."""
